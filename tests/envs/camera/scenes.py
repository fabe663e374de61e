"""Synthetic traced frames, made without a path tracer, for tests of the later steps."""

from __future__ import annotations

import numpy as np

from cavbench.envs.camera import sign
from cavbench.envs.camera.bank import BankScenes
from cavbench.envs.camera.frame import Frame, frame
from cavbench.envs.camera.poses import Pose, approach
from cavbench.envs.camera.street.layout import sign_x
from cavbench.envs.camera.street.render import Traced
from cavbench.envs.weather import WEATHERS


def lit(pose: Pose, level: float = 0.6) -> Traced:
    """A grey street in even light, with nothing in front of the sign."""
    camera = pose.camera
    x0, y0, x1, y1 = sign.box(sign_x(pose.lanes), camera)
    left, right = (int(np.clip(x, 0, camera.width)) for x in (x0 - 3, x1 + 4))
    top, bottom = (int(np.clip(y, 0, camera.height)) for y in (y0 - 3, y1 + 4))
    rows, columns = np.mgrid[top:bottom:0.25, left:right:0.25] + 0.125
    homography = sign.pixel_to_face(sign_x(pose.lanes), camera)
    place = np.stack([columns, rows, np.ones_like(rows)], -1) @ homography.T
    inside = sign.inside(place[..., :2] / place[..., 2:]).astype(np.float32)
    coverage = inside.reshape(bottom - top, 4, right - left, 4).mean((1, 3))
    depth = np.full((camera.height, camera.width), pose.distance, np.float32)
    depth[: camera.height // 4] = np.inf
    black = np.full((camera.height, camera.width, 3), 0.25, np.float32)
    black[depth == np.inf] = 0.9
    black[top:bottom, left:right] *= 1 - coverage[..., None]
    white = np.ones(3, np.float32)
    return Traced(black, (left, top, right, bottom), level * coverage[..., None] * white, coverage, white, depth[None])


def scenes(weather: str = "clear", lanes: int = 3) -> BankScenes:
    """The ten frames of an approach."""
    poses = approach("sun-behind-ego", lanes, 1.0, "sun")
    made: list[tuple[Pose, Frame]] = [(pose, frame(lit(pose), pose, WEATHERS[weather])) for pose in poses]
    return BankScenes(made, [weather] * len(made))
