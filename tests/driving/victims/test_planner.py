"""The planner drives by intervals, behind nothing."""

from __future__ import annotations

import pytest

from cavbench.driving.victims.planner import Planner
from cavbench.envs.highway.world import HighwayWorld
from cavbench.errors import UserError
from tests.driving.intervals.drivers import driven
from tests.plugins.toy import ToyWorld


def test_the_planner_drives() -> None:
    world = HighwayWorld(max_steps=120)
    columns = driven(world, Planner().load(0, world.facts), None)
    assert not columns["crashed"].any()
    assert columns["safe_progress"].mean() > 0.6
    assert (columns["assured"] > 0.9).all()


def test_a_world_without_kinematics_is_refused_in_one_line() -> None:
    with pytest.raises(UserError, match="kinematics") as refused:
        Planner().load(0, ToyWorld().facts)
    assert "\n" not in str(refused.value)
