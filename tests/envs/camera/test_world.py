"""The shipped frames: every approach of the grid, by day and by night, at places where no patch is crafted."""

from __future__ import annotations

import pytest
import torch

from cavbench.envs.camera import poses
from cavbench.envs.camera.axes import AXES
from cavbench.envs.camera.bank import SHIPPED
from cavbench.envs.camera.street.layout import LOCATIONS
from cavbench.envs.camera.world import StopSignApproach
from cavbench.envs.weather import WEATHERS

WORLD = StopSignApproach()


@pytest.mark.parametrize("weather", WEATHERS)
def test_every_approach_ships(weather: str) -> None:
    scored = {name for name, place in LOCATIONS.items() if place.scored}
    for lanes in poses.LANES:
        for density in poses.DENSITIES:
            approaches = WORLD.approaches(AXES.cell(lanes=lanes, density=density, weather=weather), range(3))
            assert {approach.location for approach in approaches} == scored
            for approach in approaches:
                distance = approach.scenes.distance
                assert torch.allclose(distance, torch.linspace(30, 8, 10), atol=0.01)
                assert (approach.scenes.visible > 0).sum() >= 6


def test_training_scenes_have_no_scored_place() -> None:
    assert all(LOCATIONS[pose.location].training for pose in WORLD.training_scenes().poses)


def test_all_frames_are_under_80_mb() -> None:
    assert sum(path.stat().st_size for path in SHIPPED.iterdir()) < 80e6


def test_a_road_that_was_not_rendered_is_one_line() -> None:
    with pytest.raises(ValueError, match="lanes must be one of 3, 4, 5, got 6"):
        AXES.cell(lanes=6, density=1.0, weather="clear")
