"""Every built-in world keeps the rules of `bench check`: it drives, or shows its frames."""

from __future__ import annotations

from tests.checks.rules import broken, built_in, each

WORLDS = built_in("world")
NEEDS = {"gym": {"id": "merge-v0"}}
"""Parameters that a world needs. `photos` needs photographs and `recorded` a scene: their own tests make some."""


@each(sorted(WORLDS.keys() - {"photos", "recorded"}))
def test_it_keeps_the_rules(name: str) -> None:
    assert broken("world", name, **NEEDS.get(name, {})) == {}
