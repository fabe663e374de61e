"""The shipped frames: every approach of the grid, by day and by night, at places where no patch is crafted."""

from __future__ import annotations

import pytest
import torch

from cavbench.core.registry import grid_of
from cavbench.detection import CameraWorld
from cavbench.envs.camera import poses
from cavbench.envs.camera.axes import AXES
from cavbench.envs.camera.bank import SHIPPED
from cavbench.envs.camera.places import StopSignPlaces
from cavbench.envs.camera.street.layout import LOCATIONS
from cavbench.envs.camera.world import StopSignApproach
from cavbench.envs.weather import WEATHERS
from tests.command import Bench

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


@pytest.mark.parametrize("world", [StopSignApproach(), StopSignPlaces()], ids=["camera", "places"])
def test_a_place_is_a_scenario_and_further_seeds_repeat_them(world: CameraWorld) -> None:
    cell = grid_of(world).cells()[0]
    count = world.scenarios(cell)
    assert count is not None
    shown = [one.scenes.render(torch.tensor([9]), None, 0.5) for one in world.approaches(cell, range(count + 1))]
    assert all(not torch.equal(shown[0], other) for other in shown[1:count])
    assert torch.equal(shown[0], shown[count])


def test_more_episodes_than_places_are_refused(bench: Bench) -> None:
    """Three times the same three approaches would have an interval that is a third as wide."""
    said = bench("run", "world=camera", "victim=fcos", "attack=none", "weather=clear", "episodes=4", "reference=false")
    assert said.code != 0
    assert len(said.err.strip().splitlines()) == 1
    assert "has 3 scenarios in the cell" in said.err
    assert "episodes=3, not 4" in said.err
