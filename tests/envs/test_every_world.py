"""Every built-in world keeps the rules of `bench check`: it drives, or shows its frames."""

from __future__ import annotations

from tests.checks.rules import broken, built_in, each

WORLDS = built_in("world")
NEEDS = {"gym": {"id": "merge-v0"}}
"""Parameters that a world needs. `photos` needs photographs, `recorded` a scene: their own tests make some. `sumo` has a test of
its own that is skipped where SUMO is not installed."""


@each(sorted(WORLDS.keys() - {"photos", "recorded", "sumo", "sumo_crossing"}))
def test_it_keeps_the_rules(name: str) -> None:
    assert broken("world", name, **NEEDS.get(name, {})) == {}
