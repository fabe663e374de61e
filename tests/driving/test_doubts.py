"""What a run says of a pair in a world before it drives: drivers that cannot brake there, and networks from another world."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

import cavbench
from cavbench import zoo
from cavbench.core.pair import Pair, choose
from cavbench.core.track import track
from cavbench.envs.roads.two_way_world import TwoWayWorld
from tests.command import Bench

FAST = {"target_speeds": (20.0, 25.0, 30.0)}
"""Found on 3 and 5 lanes at density 1 and 2 with these speeds, of 80 episodes each without an attack: `planner` crashes in 29 %,
`dqn` behind `shield` in 30 % (0 % with 10 to 30 m/s, 1 % with 15 to 30)."""


def doubts(
    victim: str = "dqn",
    defense: str = "none",
    world: dict[str, Any] | None = None,
    place: str = "highway",
    **of_victim: Any,
) -> list[str]:
    chosen = choose("victim", victim, **of_victim)
    pair = Pair(
        attack=choose("attack", "none"),
        defense=choose("defense", defense),
        victim=chosen,
        world=choose("world", place, **(world or {})),
        threat=chosen.component.threat.of_nobody(),
    )
    return list(track("driving").doubts(pair))


@pytest.mark.parametrize("victim", ["dqn", "ddpg", "planner", "idm", "random"])
@pytest.mark.parametrize("defense", ["none", "shield", "tracker+shield", "advtrain"])
def test_in_its_own_world_nothing_is_doubted(victim: str, defense: str) -> None:
    assert doubts(victim, defense) == []


@pytest.mark.parametrize(
    ("victim", "defense", "of"),
    [
        ("planner", "none", "planner"),
        ("planner", "tracker", "planner"),
        ("ppo", "shield", "shield"),
        ("ppo", "tracker+shield", "shield"),
    ],
)
def test_a_filter_that_cannot_brake_is_named(victim: str, defense: str, of: str) -> None:
    said = doubts(victim, defense, FAST)
    line = f"{of} brakes by SLOWER, which ends at 20 m/s in this world; it was made for 10 m/s"
    assert [each for each in said if each.startswith(line)]
    assert not doubts("ddpg", "shield", FAST)[1:], "continuous actions brake without a target speed"


@pytest.mark.parametrize(
    ("world", "line"),
    [
        ({"preset": "wide"}, "it saw y from -20 to 20 m, here y is -32 to 32 m"),
        ({"preset": "thesis"}, "it saw x from -100 to 100 m, here x is"),
        ({"policy_frequency": 5}, "it decided 15 times a second, here it does 5 times"),
        (FAST, "its target speeds were 10, 15, 20, 25, 30 m/s, here they are 20, 25, 30 m/s"),
    ],
)
def test_a_network_of_another_world_is_named(world: dict[str, Any], line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if world == {"preset": "thesis"}:
        line = "it saw y from -20 to 20 m, here y is -100 to 100 m"
    (said,) = doubts("dqn", world=world)
    assert said.startswith(f"dqn was trained in another world: {line}")
    (key, value), *_ = world.items()
    monkeypatch.setattr(zoo, "seeds", lambda recipe: [0])  # As if it had been trained there.
    text = f"[{','.join(map(str, value))}]" if isinstance(value, tuple) else value
    assert doubts("dqn", world=world, trained_in=f"{key}={text}") == []
    assert doubts("dqn", trained_in=f"{key}={text}"), "and the other way round"


def test_a_world_that_declares_no_target_speeds_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TwoWayWorld, "start_speed", None)  # without it a road declares no kinematics
    (said,) = doubts("dqn", place="two_way")
    assert "its target speeds were 10, 15, 20, 25, 30 m/s, here they are not declared" in said


def test_the_networks_of_the_zoo_that_were_trained_here_are_named() -> None:
    (said,) = doubts("dqn", place="racetrack")
    named = said.rpartition("choose its own: ")[2]
    assert named == "victim.decisions=12000 victim.trained_in=racetrack"
    assert doubts("dqn", place="racetrack", decisions=12_000, trained_in="racetrack") == []
    (said,) = doubts("ddpg", place="racetrack")
    assert said.endswith("train it in this one (bench train), or choose its own")


def test_vehicles_on_the_road_are_no_other_world() -> None:
    assert doubts("dqn", world={"vehicles": 5, "max_steps": 40}) == []


def test_the_command_refuses_lanes_that_cannot_be_seen_before_it_drives(bench: Bench, tmp_path: Path) -> None:
    said = bench("run", "attack=noise", "lanes=3,6", "density=1", "weather=clear", "episodes=1", f"out={tmp_path}")
    assert said.code != 0
    assert "on 6 lanes y reaches 22 m, but the observation of preset standard ends at 20 m" in said.err
    assert not list(tmp_path.rglob("*.parquet"))


def test_all_baselines_fail_or_one_does_not() -> None:
    def records(*crashed: bool, offroad: bool = False) -> pa.Table:
        return pa.table(
            {
                "crashed": crashed,
                "offroad": [offroad] * len(crashed),
                "victim": ["blind", "blind", "random"][: len(crashed)],
                "victim_params": ['{"policy":"idle"}', '{"policy":"slower"}', '{"actions":"discrete"}'][: len(crashed)],
            }
        )

    driving = track("driving")
    assert driving.hopeless(records(True, True, False)) == ""
    assert driving.hopeless(records(True, True, True)).startswith(
        "every baseline fails in every episode (idle, random, slower; 3 episodes)"
    )
    assert driving.hopeless(records(False, False, offroad=True))
    assert track("detection").hopeless(records(True)) == ""


@pytest.mark.parametrize(
    ("given", "budget"), [("2%", 0.02), ("10%", 0.1), ("0.3 %", 0.003), ("200%", 2.0), (0.5, 0.5), ("29%", 0.29)]
)
def test_a_budget_may_be_given_in_per_cent(given: Any, budget: float) -> None:
    from cavbench.api.choosing import threat_of

    assert threat_of({"budget": given}, choose("victim", "dqn"), ()).budget == budget


def test_a_budget_of_all_of_a_value_asks_back_in_python_too() -> None:
    meant = (
        r'a budget of 2 lets each value change by 200 % of itself: write threat=\{"budget": "2%"\} for 2 %, or .*"200%"'
    )
    for threat in ({"budget": 2}, cavbench.component("victim", "dqn").threat(budget=2.0)):
        with pytest.raises(cavbench.UserError, match=meant):
            cavbench.score("dqn", "noise", threat=threat, lanes=3, density=1, weather="clear", episodes=1)
