"""The camera world as a component: approaches for scoring, scenes for training, and their rendering."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

from cavbench.detection import Approach
from cavbench.envs.camera import bank, poses
from cavbench.envs.camera.axes import APPROACH_V1, AXES
from cavbench.envs.camera.bank import BankScenes, TrainingScenes
from cavbench.envs.camera.bank_world import BankWorld
from cavbench.envs.camera.poses import Pose
from cavbench.envs.camera.street.layout import LOCATIONS
from cavbench.scenarios import Axes, Cell

TRAINING_WEATHERS = ("clear", "rain", "fog")


@dataclass(frozen=True, kw_only=True)
class StopSignApproach(BankWorld):
    """An approach to a stop sign at three places: the sun behind the ego, beside it, and behind the sign.

    Args:
        bank: folder of the rendered frames; empty for the shipped frames.
    """

    title: ClassVar[str] = "camera"
    axes: ClassVar[Axes] = AXES
    grid: ClassVar[str] = APPROACH_V1.name
    locations: ClassVar[tuple[str, ...]] = tuple(place.name for place in LOCATIONS.values() if place.scored)

    def training_scenes(self) -> TrainingScenes:
        return _training(self.folder)

    def approaches(self, cell: Cell, seeds: range) -> list[Approach]:
        return [Approach(seed=seed, location=self.place(seed), scenes=self.scenes(cell, seed)) for seed in seeds]

    def scenes(self, cell: Cell, seed: int) -> BankScenes:
        """The frames of the approach of a seed, farthest first."""
        return self.on_road(self.place(seed), int(cell.lanes), float(cell.density), str(cell.weather))

    def every_pose(self) -> tuple[Pose, ...]:
        return (*poses.training(), *poses.scored())


@lru_cache(maxsize=1)
def _training(folder: Path) -> TrainingScenes:
    """Every view of the training places in the weathers of the standard grid."""
    found, weathers = [], []
    for place in LOCATIONS.values():
        for weather in TRAINING_WEATHERS if place.training else ():
            frames = bank.read(folder, place.name, weather)
            found += frames
            weathers += [weather] * len(frames)
    return TrainingScenes(found, weathers)
