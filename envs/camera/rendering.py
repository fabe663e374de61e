"""Renders the bank: traces every pose once, then develops it in each weather with that lighting.

Each traced pose is a file, so rendering is resumable.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from cavbench.envs.camera import bank
from cavbench.envs.camera.frame import frame
from cavbench.envs.camera.poses import Pose
from cavbench.envs.camera.street import layout, render
from cavbench.envs.camera.street.light import Light, light, lighting
from cavbench.envs.camera.street.render import Traced, load, trace, variant, works
from cavbench.envs.weather import WEATHERS
from cavbench.errors import UserError
from cavbench.files import whole

VERSION = 4
"""Version of the traced scene; raise it when the street or its light change."""


def path_of(folder: Path, pose: Pose) -> Path:
    """The file of a traced pose."""
    return folder / f"v{VERSION}-{variant()}" / f"{pose.name}.npz"


def traced(folder: Path, pose: Pose) -> Traced:
    """A traced pose, read from `folder`, or traced now and saved there."""
    path = path_of(folder, pose)
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        # Where the traffic waits, all poses of a lighting share a scene.
        shared = layout.LOCATIONS[pose.location].closed_loop and pose.lighting != "night"
        world, lit = _loaded(replace(pose, distance=layout.DISTANCES[0]) if shared else pose)
        found = trace(world, lit, pose.camera, layout.sign_x(pose.lanes), pose.seed)
        half = {name: value.astype(np.float16) for name, value in vars(found).items() if name != "crop"}
        with whole(path) as file:
            np.savez_compressed(file, crop=np.array(found.crop), **half)
    with np.load(path) as kept:
        single = {name: kept[name].astype(np.float32) for name in kept.files if name != "crop"}
        x0, y0, x1, y1 = (int(edge) for edge in kept["crop"])
    return Traced(crop=(x0, y0, x1, y1), **single)


@lru_cache(maxsize=1)
def _loaded(pose: Pose) -> tuple[Any, Light]:
    """The scene of a pose and its light."""
    location = layout.LOCATIONS[pose.location]
    parts = layout.street(
        location,
        lanes=pose.lanes,
        density=pose.density,
        distance=pose.distance,
        lights=pose.lighting == "night",
    )
    lit = light(pose.lighting, location.sun_azimuth_deg)
    return load(parts, lit, pose.camera, layout.sign_x(pose.lanes)), lit


def make(poses: Sequence[Pose], *, kept: Path, out: Path, progress: Callable[[float, str], None]) -> list[Path]:
    """Trace the missing poses, and write the bank of all poses.

    Args:
        poses: poses of any places and lightings.
        kept: folder of traced poses, some 6 MB each.
        out: folder of the bank.
        progress: called with the share done and a short text.

    Returns:
        The files written, one for each place and weather.

    Raises:
        UserError: if the renderer is not installed.
    """
    missing = [pose for pose in poses if not path_of(kept, pose).exists()]
    if missing:
        _check_installed()
    for number, pose in enumerate(missing):
        progress(number / len(missing), pose.name)
        traced(kept, pose)
    written = []
    for location in dict.fromkeys(pose.location for pose in poses):
        for weather in WEATHERS.values():
            there = [pose for pose in poses if pose.location == location and pose.lighting == lighting(weather)]
            if there:
                progress(1.0, f"{location} in {weather.name}")
                frames = [frame(traced(kept, pose), pose, weather) for pose in there]
                written.append(bank.write(out, location, weather.name, there, frames, _made_by()))
    return written


def _made_by() -> dict[str, object]:
    """Provenance in the metadata of a file of the bank."""
    return {
        "version": VERSION,
        "variant": variant(),
        "samples": [render.SAMPLES, render.GUIDE_SAMPLES, render.SIGN_SAMPLES],
        "libraries": {name: metadata.version(name) for name in ("mitsuba", "pyoidn")},
    }


def _check_installed() -> None:
    """Raise UserError unless the renderer is installed and renders a small picture."""
    for name in ("mitsuba", "pyoidn"):
        try:
            metadata.version(name)
        except metadata.PackageNotFoundError:
            raise UserError(f"rendering needs {name}: pip install 'cavbench[render]'") from None
    if not works(variant()):
        raise UserError(
            f"the renderer cannot render with the variant {variant()!r}: its LLVM library may be missing or broken; "
            "MITSUBA_VARIANT=scalar_rgb needs none and is slower"
        )
