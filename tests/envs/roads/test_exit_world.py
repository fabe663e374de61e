"""The motorway exit as a world."""

from __future__ import annotations

from cavbench.envs.roads.axes import EXIT
from cavbench.envs.roads.exit_world import ExitWorld


def test_perfect_information_finds_the_exit_from_the_far_lanes() -> None:
    env = ExitWorld().make([EXIT.cell(lanes=6, density=1.0)] * 4, driver="clairvoyant")
    drive = env.rollout(300, break_when_all_done=True)
    assert not drive["next", "info", "crashed"].any()
    # With plans of four seconds it is one of four.
    assert env.engine.episodes["arrived"].sum() >= 3
