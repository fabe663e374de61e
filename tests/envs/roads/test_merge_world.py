"""The world `merge`: its axes and its drivers."""

from __future__ import annotations

import numpy as np
import pytest

from cavbench.driving import Control
from cavbench.envs.highway.engine import Flag, Number
from cavbench.envs.roads.axes import MERGE
from cavbench.envs.roads.engine import RoadsEngine
from cavbench.envs.roads.merge_world import MergeWorld

SPARSE, DENSE = MERGE.cell(density=1.0, ramp=80.0), MERGE.cell(density=4.0, ramp=40.0)
SEEDS = np.arange(1_000_000, 1_000_016)


def driven(cell: object, driver: str, action: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Safe progress and crashes of sixteen episodes."""
    engine = RoadsEngine(MergeWorld().config((cell,) * len(SEEDS), Control(driver=driver)))  # type: ignore[arg-type]
    engine.reset(np.arange(len(SEEDS)), SEEDS)
    progress = np.zeros(len(SEEDS))
    for _ in range(300):
        engine.step(np.full(len(SEEDS), action))
        progress += engine.numbers[Number.PROGRESS]
    assert engine.flags[Flag.DONE].all()
    failed = engine.flags[Flag.CRASHED] | engine.flags[Flag.OFFROAD]
    return np.where(failed, 0.0, progress / 300), engine.flags[Flag.CRASHED]


def test_dense_traffic_punishes_a_blind_car_and_not_the_traffics_own_driver() -> None:
    blind, crashed = driven(DENSE, "agent")
    assert crashed.mean() > 0.5
    ruled, crashed = driven(DENSE, "idm")
    assert not crashed.any()
    assert ruled.mean() > blind.mean() + 0.2


def test_a_short_drive_with_perfect_information_does_not_fail() -> None:
    world = MergeWorld(max_steps=120)
    env = world.make([DENSE] * 4, driver="clairvoyant")
    drive = env.rollout(120, break_when_all_done=True)
    assert not drive["next", "info", "crashed"].any()
    assert not drive["next", "info", "offroad"].any()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"policy_frequency": 4}, "policy_frequency must divide simulation_frequency"),
        ({"observed_vehicles": 1}, "observed_vehicles must be between 2 and 1001"),
        ({"target_speeds": (30.0, 20.0)}, "increasing speeds"),
        ({"max_steps": 0}, "max_steps must be a whole number of at least 1"),
    ],
)
def test_a_wrong_parameter_is_one_line(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        MergeWorld(**options)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


def test_an_action_that_there_is_not_is_refused() -> None:
    engine = RoadsEngine(MergeWorld().config((SPARSE,)))
    engine.reset(np.array([0]), np.array([1]))
    with pytest.raises(ValueError, match="between 0 and 4"):
        engine.step(np.array([5]))
