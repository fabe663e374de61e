"""The camera world as a component: approaches for scoring, scenes for training, and their rendering."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

from platformdirs import user_cache_path

from bench.detection import Approach, CameraWorld
from bench.errors import UserError
from bench.plugins.contracts import Progress
from bench.scenarios import Axes, Cell
from envs.camera import bank, poses
from envs.camera.axes import APPROACH_V1, AXES
from envs.camera.bank import BankScenes, TrainingScenes
from envs.camera.objects import NAMES
from envs.camera.street.layout import LOCATIONS

TRAINING_WEATHERS = ("clear", "rain", "fog")


@dataclass(frozen=True, kw_only=True)
class StopSignApproach(CameraWorld):
    """An approach to a stop sign at three places: the sun behind the ego, beside it, and behind the sign.

    Args:
        bank: folder of the rendered frames; empty for the shipped frames.
    """

    axes: ClassVar[Axes] = AXES
    grid: ClassVar[str] = APPROACH_V1.name
    locations: ClassVar[tuple[str, ...]] = tuple(place.name for place in LOCATIONS.values() if place.scored)

    classes: ClassVar[tuple[str, ...]] = NAMES

    bank: str = ""

    def __post_init__(self) -> None:
        if self.bank and not Path(self.bank).expanduser().is_dir():
            raise ValueError(f"camera.bank must be a folder of rendered frames, got {self.bank}")

    @property
    def folder(self) -> Path:
        """Folder of the frames."""
        return Path(self.bank).expanduser() if self.bank else bank.SHIPPED

    def training_scenes(self) -> TrainingScenes:
        return _training(self.folder)

    def approaches(self, cell: Cell, seeds: range) -> list[Approach]:
        return [self._approach(cell, seed) for seed in seeds]

    def _approach(self, cell: Cell, seed: int) -> Approach:
        location = self.locations[seed % len(self.locations)]
        frames = [
            (pose, frame)
            for pose, frame in _read(self.folder, location, cell.weather)
            if (pose.lanes, pose.density) == (cell.lanes, cell.density)
        ]
        if not frames:
            raise UserError(f"no frames of {location} with {cell} in {self.folder}; `bench render` makes them")
        scenes = BankScenes(frames, [cell.weather] * len(frames))
        return Approach(seed=seed, location=location, scenes=scenes)

    def render(self, out: Path | None, progress: Progress) -> list[Path]:
        """Trace the missing poses, and write the bank.

        Args:
            out: folder of the bank; None for the shipped bank.
            progress: called with the share done.

        Raises:
            UserError: if the renderer is not installed.
        """
        from envs.camera import rendering

        every = (*poses.training(), *poses.scored())
        kept = user_cache_path("cavbench") / "street"
        return rendering.make(every, kept=kept, out=out or self.folder, progress=progress)


@lru_cache(maxsize=4)
def _read(folder: Path, location: str, weather: str) -> list[tuple[poses.Pose, bank.Frame]]:
    return bank.read(folder, location, weather)


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
