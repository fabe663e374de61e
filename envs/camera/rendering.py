"""Tracing the poses of the bank, one file each, so that a render that was broken off goes on."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bench.files import whole
from envs.camera.poses import Pose
from envs.camera.street import layout
from envs.camera.street.light import light
from envs.camera.street.render import Traced, trace, variant

VERSION = 1
"""Of everything that decides what is traced; raised when the street or its light change."""


def path_of(folder: Path, pose: Pose) -> Path:
    """Where a traced pose is kept."""
    return folder / f"v{VERSION}-{variant()}" / f"{pose.name}.npz"


def traced(folder: Path, pose: Pose) -> Traced:
    """A pose, out of `folder` or traced now and kept there."""
    path = path_of(folder, pose)
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        location = layout.LOCATIONS[pose.location]
        parts = layout.street(
            location,
            lanes=pose.lanes,
            density=pose.density,
            distance=pose.distance,
            lights=pose.lighting == "night",
        )
        lit = light(pose.lighting, location.sun_azimuth_deg)
        found = trace(parts, lit, pose.camera, layout.sign_x(pose.lanes), pose.seed)
        half = {name: value.astype(np.float16) for name, value in vars(found).items() if name != "crop"}
        with whole(path) as file:
            np.savez(file, crop=np.array(found.crop), **half)
    with np.load(path) as kept:
        single = {name: kept[name].astype(np.float32) for name in kept.files if name != "crop"}
        x0, y0, x1, y1 = (int(edge) for edge in kept["crop"])
    return Traced(crop=(x0, y0, x1, y1), **single)
