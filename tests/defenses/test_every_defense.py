"""Every built-in defence is loaded, keeps the rules of `bench check`, and answers in its victim's place."""

from __future__ import annotations

from tests.checks.rules import broken, built_in, each

DEFENSES = built_in("defense")


@each(DEFENSES)
def test_it_keeps_the_rules(name: str) -> None:
    assert broken("defense", name) == {}
