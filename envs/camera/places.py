"""Ten places as a component: an approach to a stop sign at each, on the same road."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from cavbench.detection import Approach, Scenes
from cavbench.envs.camera import poses
from cavbench.envs.camera.bank_world import BankWorld
from cavbench.envs.camera.places_axes import AXES, PLACES_V1
from cavbench.envs.camera.poses import Pose
from cavbench.envs.camera.street.layout import LOCATIONS
from cavbench.envs.camera.world import StopSignApproach
from cavbench.scenarios import Axes, Cell


@dataclass(frozen=True, kw_only=True)
class StopSignPlaces(BankWorld):
    """An approach to a stop sign at each of ten places, on a road with four lanes: the three of `camera`, and seven more.

    Args:
        bank: folder of the rendered frames; empty for the shipped frames.
    """

    title: ClassVar[str] = "places"
    axes: ClassVar[Axes] = AXES
    grid: ClassVar[str] = PLACES_V1.name
    locations: ClassVar[tuple[str, ...]] = (
        *StopSignApproach.locations,
        *(place.name for place in LOCATIONS.values() if place.one_road),
    )

    def training_scenes(self) -> Scenes:
        """Those of the world `camera`."""
        return self._street.training_scenes()

    def approaches(self, cell: Cell, seeds: range) -> list[Approach]:
        found = []
        for seed in seeds:
            place = self.place(seed)
            scenes = self.on_road(place, poses.ONE_ROAD_LANES, poses.ONE_ROAD_DENSITY, str(cell.weather))
            found.append(Approach(seed=seed, location=place, scenes=scenes))
        return found

    @property
    def _street(self) -> StopSignApproach:
        return StopSignApproach(bank=self.bank)

    def every_pose(self) -> tuple[Pose, ...]:
        """Those of the world `camera`, and those of the seven places."""
        return (*self._street.every_pose(), *poses.one_road())
