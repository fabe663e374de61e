"""The world `sumo`: its parameters, its facts, and the rules that every world keeps."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
import torch

from cavbench.driving import Control
from cavbench.envs.highway.config import ACTIONS
from cavbench.envs.highway.world import HighwayWorld
from cavbench.envs.sumo import network
from cavbench.envs.sumo.axes import SUMO, SUMO_V1
from cavbench.envs.sumo.cars import Model, start
from cavbench.envs.sumo.motorway import ON_MOTORWAY, ON_RAMP
from cavbench.envs.sumo.world import SumoWorld
from cavbench.errors import UserError
from tests.checks.rules import broken

FASTER = ACTIONS.index("FASTER")
needs_sumo = pytest.mark.skipif(
    importlib.util.find_spec("libsumo") is None, reason="needs SUMO: pip install 'cavbench[sumo]'"
)


@needs_sumo
def test_it_keeps_the_rules_of_every_world() -> None:
    assert broken("world", "sumo") == {}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"processes": 0}, "processes must be"),
        ({"observed_vehicles": 1}, "observed_vehicles must be between 2 and 1001"),
        ({"target_speeds": (30.0, 20.0)}, "increasing speeds"),
        ({"vehicles": 0}, "vehicles must be between 1 and 1000"),
        ({"max_steps": 0}, "max_steps must be"),
        ({"max_steps": 900}, "max_steps must be at most 820, where the road ends"),
    ],
)
def test_a_wrong_parameter_is_one_line(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        SumoWorld(**options)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("axis", ["lanes", "density"])
def test_a_cell_that_there_is_not_is_one_line(axis: str) -> None:
    with pytest.raises(ValueError, match=rf"^{axis} must be .*, got 9$"):
        SUMO.cell(**{"lanes": 3, "density": 1.0, axis: 9})


def test_without_sumo_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network, "LIBRARIES", ("sumo-that-nobody-has",))
    world = SumoWorld()
    with pytest.raises(UserError, match=r"needs sumo-that-nobody-has 1\.28: pip install 'cavbench\[sumo\]'$"):
        world.doubts([world.home])
    with pytest.raises(UserError, match=r"pip install 'cavbench\[sumo\]'$"):
        world.make([world.home])


def test_another_version_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    # Any distribution that is there, in a version that is not SUMO's.
    monkeypatch.setattr(network, "LIBRARIES", ("numpy",))
    with pytest.raises(UserError, match=r"needs numpy 1\.28, but .* is installed"):
        network.check_installed()


def test_policies_of_highway_find_their_features_and_actions() -> None:
    ours, theirs = SumoWorld().facts, HighwayWorld().facts
    assert (ours.features, ours.actions, ours.rows) == (theirs.features, theirs.actions, theirs.rows)
    assert ours.kinematics is not None
    assert ours.kinematics.start_speed == 25.0
    assert SumoWorld().dynamics([SUMO_V1.cells()[0]], "discrete").actions == len(ours.actions)


def test_the_cars_of_an_episode_follow_from_its_seed() -> None:
    for cell in SUMO_V1.cells():
        for seed in range(1_000_000, 1_000_020):
            cars = start(3, seed, cell, 20, Model.EGO)
            assert cars.tobytes() == start(3, seed, cell, 20, Model.EGO).tobytes()
            assert (cars["number"] < 21).all()
            assert cars["model"][0] == Model.EGO
            assert cars["lane"].max() < cell.lanes
            for route, lane in [(ON_RAMP, 0), *((ON_MOTORWAY, lane) for lane in range(cell.lanes))]:
                fronts = np.sort(cars["front"][(cars["route"] == route) & (cars["lane"] == lane)])
                # No two bodies touch, and SUMO's gap between bumpers is there.
                assert (np.diff(fronts) > 7.5).all()
    home = SumoWorld().home
    assert start(0, 1, home, 20, Model.EGO).tobytes() != start(0, 2, home, 20, Model.EGO).tobytes()


@needs_sumo
def test_the_rule_based_driver_does_not_crash_where_a_blind_car_does() -> None:
    world, cell = SumoWorld(max_steps=200), SUMO.cell(lanes=2, density=2.0)
    crashes = {}
    for driver in ("agent", "idm"):
        env = world.build([cell] * 8, Control(driver=driver))  # type: ignore[arg-type]
        drive = env.rollout(200, policy=lambda td: td.set("action", torch.full((8,), FASTER)), break_when_all_done=True)
        crashes[driver] = int(drive["next", "info", "crashed"].any(1).sum())
        assert not drive["next", "info", "offroad"].any()
        env.close()
    assert crashes["idm"] == 0
    assert crashes["agent"] >= 6
