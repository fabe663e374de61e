"""Scenes that were read, kept for the process."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from cavbench import bounded
from cavbench.envs.recorded import commonroad
from cavbench.envs.recorded.frames import Stage, stage
from cavbench.errors import UserError


@lru_cache(maxsize=16)
def staged(path: Path, sha256: str, hz: int, seconds: float, change: float) -> Stage:
    """The scene in a file. It is cached, because the engine tells roads apart by their identity.

    Args:
        path: the file.
        sha256: what it must be.
        hz: physics frames per second.
        seconds, change: as of `cavbench.envs.recorded.frames.stage`.

    Raises:
        UserError: in one line, if it is another file, or cannot be driven.
    """
    if (found := bounded.sha256(path, most=bounded.TEXT)) != sha256:
        raise UserError(f"{path} has sha256 {found[:12]}…, not {sha256[:12]}…: it was changed")
    recording = commonroad.read(path)
    try:
        return stage(recording, hz, seconds, change)
    except ValueError as error:
        raise UserError(f"{path.name} cannot be driven: {error}") from None
