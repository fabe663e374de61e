"""The base of worlds whose frames lie in a bank on disk."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

from platformdirs import user_cache_path

from cavbench.core.contracts import Progress
from cavbench.detection import CameraWorld
from cavbench.envs.camera import bank
from cavbench.envs.camera.bank import BankScenes
from cavbench.envs.camera.objects import NAMES
from cavbench.envs.camera.poses import Pose
from cavbench.errors import UserError
from cavbench.scenarios import Cell


@dataclass(frozen=True, kw_only=True)
class BankWorld(CameraWorld):
    """A world of rendered frames; a subclass says which poses it shows.

    Args:
        bank: folder of the rendered frames; empty for the shipped frames.
    """

    title: ClassVar[str]
    """Name of the component, for messages."""
    classes: ClassVar[tuple[str, ...]] = NAMES
    mounts: ClassVar[bool] = True

    bank: str = ""

    def __post_init__(self) -> None:
        if self.bank and not Path(self.bank).expanduser().is_dir():
            raise ValueError(f"{self.title}.bank must be a folder of rendered frames, got {self.bank}")

    @property
    def folder(self) -> Path:
        """Folder of the frames."""
        return Path(self.bank).expanduser() if self.bank else bank.SHIPPED

    def place(self, seed: int) -> str:
        """Name of the place that a scenario seed is driven at."""
        return self.locations[seed % len(self.locations)]

    def scenarios(self, cell: Cell) -> int | None:
        """See `World.scenarios`: one for each place."""
        return len(self.locations)

    def on_road(self, location: str, lanes: int, density: float, weather: str) -> BankScenes:
        """The frames of the approach at a place, farthest first.

        Args:
            location: name of the place.
            lanes, density: the road.
            weather: name of the weather.

        Raises:
            UserError: if the bank has no such frames.
        """
        frames = [
            (pose, frame)
            for pose, frame in _read(self.folder, location, weather)
            if (pose.lanes, pose.density) == (lanes, density)
        ]
        if not frames:
            road = f"{lanes} lanes at density {density:g}"
            raise UserError(f"no frames of {location} with {road} in {self.folder}; `bench render` makes them")
        return BankScenes(frames, [weather] * len(frames))

    @abstractmethod
    def every_pose(self) -> tuple[Pose, ...]:
        """Every pose that it shows."""

    def render(self, out: Path | None, progress: Progress) -> list[Path]:
        """Trace the missing poses, and write the bank.

        Args:
            out: folder of the bank; None for the shipped bank.
            progress: called with the share done.

        Raises:
            UserError: if the renderer is not installed.
        """
        from cavbench.envs.camera import rendering

        kept = user_cache_path("cavbench") / "street"
        return rendering.make(self.every_pose(), kept=kept, out=out or self.folder, progress=progress)


@lru_cache(maxsize=4)
def _read(folder: Path, location: str, weather: str) -> list[tuple[Pose, bank.Frame]]:
    return bank.read(folder, location, weather)
