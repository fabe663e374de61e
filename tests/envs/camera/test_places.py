"""The world `places`: an approach at each of ten places, on one road, at none of which anything is trained or crafted."""

from __future__ import annotations

import pytest
import torch

from cavbench.envs.camera import poses
from cavbench.envs.camera.axes import AXES as STREET
from cavbench.envs.camera.places import StopSignPlaces
from cavbench.envs.camera.places_axes import AXES, PLACES_V1
from cavbench.envs.camera.street.layout import LOCATIONS, traffic
from cavbench.envs.camera.world import StopSignApproach
from cavbench.errors import UserError

WORLD = StopSignPlaces()


@pytest.mark.parametrize("weather", PLACES_V1.values["weather"])
def test_ten_places_ship(weather: str) -> None:
    approaches = WORLD.approaches(AXES.cell(weather=weather), range(1_000_000, 1_000_000 + PLACES_V1.episodes))
    assert len({approach.location for approach in approaches}) == 10
    for approach in approaches:
        assert torch.allclose(approach.scenes.distance, torch.linspace(30, 8, 10), atol=0.01)
        assert (approach.scenes.visible > 0).sum() >= 6


def test_three_places_are_those_of_camera() -> None:
    cell = AXES.cell(weather="rain")
    of_camera = StopSignApproach().approaches(
        STREET.cell(lanes=poses.ONE_ROAD_LANES, density=poses.ONE_ROAD_DENSITY, weather="rain"), range(3)
    )
    theirs = {approach.location: approach.scenes.poses for approach in of_camera}
    mine = {approach.location: approach.scenes.poses for approach in WORLD.approaches(cell, range(10))}
    assert {name: mine[name] for name in theirs} == theirs


def test_every_place_is_another_one_and_none_is_for_training() -> None:
    places = [LOCATIONS[name] for name in WORLD.locations]
    assert not any(place.training for place in places)
    assert len({place.seed for place in LOCATIONS.values()}) == len(LOCATIONS)
    cars = [traffic(place, poses.ONE_ROAD_LANES, poses.ONE_ROAD_DENSITY) for place in places]
    assert len(set(cars)) == len(places)
    assert all(LOCATIONS[pose.location].training for pose in WORLD.training_scenes().poses)


def test_a_road_without_frames_is_one_line() -> None:
    with pytest.raises(UserError, match=r"no frames of avenue-80 with 3 lanes at density 1 in .*`bench render`"):
        WORLD.on_road("avenue-80", 3, 1.0, "clear")
