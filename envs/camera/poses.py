"""All views of the street: approaches for scoring, and views of other places for training."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache, cached_property
from typing import get_args

import numpy as np

from cavbench.envs.camera.axes import AXES
from cavbench.envs.camera.camera import Camera
from cavbench.envs.camera.street import occlusion
from cavbench.envs.camera.street.layout import DISTANCES, LOCATIONS, sign_x, traffic
from cavbench.envs.camera.street.light import Lighting

LANES = [int(lanes) for lanes in AXES["lanes"].choices]
DENSITIES = [float(density) for density in AXES["density"].choices]
TRAINING_VIEWS = 12
"""Number of views of each training place under each lighting."""
DAYLIGHT: tuple[Lighting, ...] = ("sun", "overcast")
"""The lightings of the weathers in the standard grid."""
LEAST_VISIBLE = 0.6
"""Approximate share of the sign that a training view shows at least."""
CLOSED_LOOP_LANES, CLOSED_LOOP_DENSITY = 3, 1.0
CLOSED_LOOP_DISTANCES = tuple(map(float, (*np.arange(60.0, 30.5, -1.0), *np.arange(30.0, 7.9, -0.5))))
"""Distances of the frames of the closed loop to the sign, in m: twice as far apart where the sign grows half as fast."""
ONE_ROAD_LANES, ONE_ROAD_DENSITY = 4, 1.0


@dataclass(frozen=True, kw_only=True)
class Pose:
    """One view of one place.

    Args:
        location: a name in `LOCATIONS`.
        lanes: number of lanes of the road.
        density: traffic density.
        lighting: light that it is traced in.
        distance: distance of the camera to the sign in m.
        x: camera position to the right of the middle of the lane, in m.
        yaw_deg, pitch_deg: direction of the camera.
    """

    location: str
    lanes: int
    density: float
    lighting: Lighting
    distance: float
    x: float = 0.0
    yaw_deg: float = 0.0
    pitch_deg: float = 1.0

    @property
    def camera(self) -> Camera:
        """The camera of this view."""
        return Camera(x=self.x, y=-self.distance, yaw_deg=self.yaw_deg, pitch_deg=self.pitch_deg)

    @cached_property
    def seed(self) -> int:
        """Seed of everything random in the image."""
        text = ",".join(f"{key}={value}" for key, value in asdict(self).items())
        return int(hashlib.sha256(text.encode()).hexdigest()[:8], 16)

    @property
    def name(self) -> str:
        """Name of its files."""
        road = f"{self.lanes}-lanes-density-{self.density:g}"
        return f"{self.location}-{self.lighting}-{road}-{self.distance:.2f}m-{self.seed:08x}"


def approach(
    location: str, lanes: int, density: float, lighting: Lighting, distances: Sequence[float] = DISTANCES
) -> tuple[Pose, ...]:
    """The poses of an approach, farthest first."""
    return tuple(
        Pose(location=location, lanes=lanes, density=density, lighting=lighting, distance=distance)
        for distance in distances
    )


@cache
def scored() -> tuple[Pose, ...]:
    """Every pose of every approach."""
    return tuple(
        pose
        for lighting in get_args(Lighting)
        for lanes in LANES
        for density in DENSITIES
        for location in LOCATIONS.values()
        if location.scored
        for pose in approach(location.name, lanes, density, lighting)
    )


@cache
def one_road() -> tuple[Pose, ...]:
    """Every pose of the places that are rendered on one road."""
    return tuple(
        pose
        for location in LOCATIONS.values()
        if location.one_road
        for lighting in DAYLIGHT
        for pose in approach(location.name, ONE_ROAD_LANES, ONE_ROAD_DENSITY, lighting)
    )


@cache
def closed_loop() -> tuple[Pose, ...]:
    """Every pose of the road that is driven in closed loop, farthest first under each lighting."""
    return tuple(
        pose
        for location in LOCATIONS.values()
        if location.closed_loop
        for lighting in DAYLIGHT
        for pose in approach(location.name, CLOSED_LOOP_LANES, CLOSED_LOOP_DENSITY, lighting, CLOSED_LOOP_DISTANCES)
    )


@cache
def training() -> tuple[Pose, ...]:
    """Views of the training places, at random distances, slightly off the middle and the direction of the lane."""
    poses: list[Pose] = []
    for number, lighting in enumerate(DAYLIGHT):
        for location in LOCATIONS.values():
            rng = np.random.default_rng([location.seed, number])
            wanted = len(poses) + TRAINING_VIEWS * location.training
            while len(poses) < wanted:
                pose = Pose(
                    location=location.name,
                    lanes=int(rng.choice(LANES)),
                    density=float(rng.choice(DENSITIES)),
                    lighting=lighting,
                    distance=round(float(np.exp(rng.uniform(np.log(8.5), np.log(31.0)))), 2),
                    x=round(float(rng.normal(0, 0.25)), 2),
                    yaw_deg=round(float(rng.normal(0, 1.0)), 2),
                    pitch_deg=round(float(rng.normal(1.0, 0.5)), 2),
                )
                if _visible(pose) >= LEAST_VISIBLE:
                    poses.append(pose)
    return tuple(poses)


def _visible(pose: Pose) -> float:
    """Approximate share of the sign that a view shows."""
    placed = traffic(LOCATIONS[pose.location], pose.lanes, pose.density)
    vehicles = [(each.model, each.x, each.later(pose.distance)) for each in placed]
    return occlusion.visible(pose.camera, sign_x(pose.lanes), vehicles)
