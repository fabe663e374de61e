"""The base of worlds whose frames lie in a bank on disk."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from platformdirs import user_cache_path

from bench.detection import CameraWorld
from bench.plugins.contracts import Progress
from envs.camera import bank
from envs.camera.objects import NAMES
from envs.camera.poses import Pose


@dataclass(frozen=True, kw_only=True)
class BankWorld(CameraWorld):
    """A world of rendered frames; a subclass says which poses it shows.

    Args:
        bank: folder of the rendered frames; empty for the shipped frames.
    """

    title: ClassVar[str]
    """Name of the component, for messages."""
    classes: ClassVar[tuple[str, ...]] = NAMES

    bank: str = ""

    def __post_init__(self) -> None:
        if self.bank and not Path(self.bank).expanduser().is_dir():
            raise ValueError(f"{self.title}.bank must be a folder of rendered frames, got {self.bank}")

    @property
    def folder(self) -> Path:
        """Folder of the frames."""
        return Path(self.bank).expanduser() if self.bank else bank.SHIPPED

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
        from envs.camera import rendering

        kept = user_cache_path("cavbench") / "street"
        return rendering.make(self.every_pose(), kept=kept, out=out or self.folder, progress=progress)
