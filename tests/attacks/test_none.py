"""No attack: the victim sees the truth, and nobody asks it anything."""

from __future__ import annotations

from cavbench.checks import examine
from cavbench.driving.drive import drive
from cavbench.run.config import plan_of

ROAD = (
    "victim=dqn",
    "lanes=3",
    "density=2",
    "weather=clear",
    "episodes=2",
    "seeds=0",
    "world.max_steps=20",
    "reference=false",
)


def test_it_keeps_the_rules() -> None:
    assert [outcome.text for outcome in examine("attack", "none") if outcome.status == "fail"] == []


def test_without_an_attack_the_truth_is_shown() -> None:
    found = {}
    for words in (("attack=none",), ("attack=noise",)):
        units = [unit for unit in plan_of([*words, *ROAD]).units() if unit.pair.attack.name in words[0]]
        found[words[0]] = drive(units[0].job, []).columns
    clean, noisy = found.values()
    assert not clean["linf"].any()
    assert not clean["queries"].any()
    assert (noisy["linf"] > 0).all()
    assert (clean["steps"] == 20).all()
