"""Bad input is refused with one line that says what is allowed."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest

from cavbench.driving import DrivingWorld, Features
from cavbench.envs.highway.axes import AXES
from cavbench.envs.highway.config import STANDARD_FEATURES, THESIS_FEATURES, HighwayConfig
from cavbench.envs.highway.world import HighwayWorld
from tests.tree import ROOT


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"cells": ()}, "at least one cell"),
        ({"vehicles": 0}, "vehicles must be between 1 and 1000, got 0"),
        ({"ego_spacing": 0}, "ego_spacing must be positive"),
        ({"simulation_frequency": 0}, "simulation_frequency must be a whole number"),
        ({"policy_frequency": 4}, "policy_frequency must divide simulation_frequency"),
        ({"policy_frequency": 30}, "policy_frequency must divide simulation_frequency"),
        ({"max_steps": 0}, "max_steps must be at least 1"),
        ({"action_repeat": 0}, "action_repeat must be at least 1"),
        ({"action_type": "both"}, "action_type must be one of discrete, continuous, got 'both'"),
        ({"driver": "human"}, "driver must be one of agent, idm, clairvoyant, got 'human'"),
        ({"target_speeds": (20.0,)}, "at least two increasing speeds"),
        ({"target_speeds": (30.0, 20.0)}, r"at least two increasing speeds from 0 to 40 m/s, got \(30, 20\)"),
        ({"target_speeds": (20.0, 50.0)}, "from 0 to 40 m/s"),
        ({"observed_vehicles": 1}, "observed_vehicles must be between 2"),
        ({"features": Features(("x",), (-1,), (1,), ("m",))}, "features must be x, y, vx, vy"),
        ({"features": Features(("x", "y", "vx", "vy"), (1,) * 4, (0,) * 4, ("m",) * 4)}, "the range of x must be"),
        ({"reward_speed_range": (30.0, 30.0)}, "reward_speed_range must be finite and increasing"),
        ({"collision_reward": float("nan")}, "reward weights must be finite"),
        ({"collision_reward": 0.5}, "normalize_reward needs"),
    ],
)
def test_a_bad_configuration_is_refused_with_the_reason(bad: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        HighwayConfig(**bad)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"preset": "mine"}, "preset must be one of standard, thesis, wide, got 'mine'"),
        ({"backend": "torch"}, "backend must be one of batched, reference, got 'torch'"),
        ({"vehicles": -1}, "vehicles must be between"),
        ({"target_speeds": (1.0,)}, "target_speeds must be"),
    ],
)
def test_a_bad_world_is_refused_with_the_reason(bad: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        HighwayWorld(**bad)


def test_the_presets_are_standard_and_thesis() -> None:
    standard, thesis = HighwayWorld(), HighwayWorld(preset="thesis")
    assert isinstance(standard, DrivingWorld)
    assert standard.features == HighwayWorld.features == STANDARD_FEATURES
    assert thesis.features == THESIS_FEATURES
    cells = (AXES.cell(lanes=3, density=1.0),)
    assert thesis.configuration(cells) == HighwayConfig.thesis(cells=cells)
    assert standard.configuration(cells) == HighwayConfig(cells=cells)
    assert standard.max_steps == 450


def test_worlds_with_equal_fields_are_equal_and_hashable() -> None:
    assert HighwayWorld(vehicles=50) == HighwayWorld(vehicles=50) != HighwayWorld()
    assert hash(HighwayWorld(preset="thesis")) == hash(HighwayWorld(preset="thesis"))


def test_kernels_run_without_a_writable_cache() -> None:
    program = (
        "import numba.core.caching as caching, numpy as np\n"
        # As on a read-only installation without a home: numba finds nowhere to write.
        "for locator in caching.CacheImpl._locator_classes: locator.from_function = classmethod(lambda *a: None)\n"
        # Every kernel of the engine is declared; the smallest one is compiled, in seconds.
        "from cavbench.envs.highway import engine, spawn\n"
        "from cavbench.envs.highway.sensor import add_noise\n"
        "measured = np.zeros(4)\n"
        "add_noise(measured, 1.0, 1, 2, 3)\n"
        "kernels = engine.step_batch, engine.observe_batch, spawn.spawn_batch, add_noise\n"
        "print(measured.all(), {type(kernel._cache).__name__ for kernel in kernels}, add_noise.nopython_signatures)\n"
    )
    command = [sys.executable, "-W", "ignore", "-c", program]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "True {'NullCache'} [(" in done.stdout


def test_records_of_the_reference_backend_name_highway_envs_version() -> None:
    assert HighwayWorld(backend="reference").libraries == ("highway-env",)
    assert HighwayWorld().libraries == ()
