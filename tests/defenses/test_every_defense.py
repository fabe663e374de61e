"""Every built-in defence is loaded, keeps the rules of `bench check`, and answers in its victim's place."""

from __future__ import annotations

from tests.checks.rules import broken, built_in, each

OWN_TESTS = {"misbehaviour"}
"""Defences for victims that listen to other cars, which the usual victim does not."""
DEFENSES = built_in("defense").keys() - OWN_TESTS


@each(sorted(DEFENSES))
def test_it_keeps_the_rules(name: str) -> None:
    assert broken("defense", name) == {}
