"""Labels of a frame: the stop sign, vehicles and other signs, from their outlines."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from cavbench.detection import STOP_SIGN
from cavbench.envs.camera import sign
from cavbench.envs.camera.camera import Array
from cavbench.envs.camera.poses import Pose
from cavbench.envs.camera.street.layout import LOCATIONS, OtherSign, other_signs, sign_x, traffic
from cavbench.envs.camera.street.vehicles import PAINTS, Model, vehicle

NAMES = (STOP_SIGN, "car", "truck", "traffic sign")
"""Class names. Vans are trucks; other signs have their own class, so that detectors learn to tell them from stop signs."""
CLASSES: dict[Model, str] = {"saloon": "car", "hatchback": "car", "van": "truck", "lorry": "truck"}
LEAST_VISIBLE, LEAST_PX = 0.3, 6
"""An object that shows a smaller share of its outline, or is narrower or lower in pixels, has no label."""
AHEAD_M = 1.0
"""An object that is not entirely this far ahead of the camera hides other objects but has no label."""


@dataclass(frozen=True)
class _Outlined:
    name: str
    outline: Array
    depth: float


def objects(pose: Pose) -> list[tuple[str, Array]]:
    """Class and box [4] in pixels, clipped to the image, of every labelled object.

    An object has a label if enough of its outline is inside the image and not hidden by nearer objects.
    """
    camera = pose.camera
    found = sorted(_outlined(pose), key=lambda one: -one.depth)
    drawn = np.full((camera.height, camera.width), -1, np.int32)
    hulls = [cv2.convexHull(one.outline.astype(np.float32)) for one in found]
    for number, hull in enumerate(hulls):
        cv2.fillConvexPoly(drawn, np.rint(hull).astype(np.int32), number)
    seen = []
    for number, (one, hull) in enumerate(zip(found, hulls, strict=True)):
        low, high = hull[:, 0].min(0), hull[:, 0].max(0)
        box = np.concatenate([low, high]).clip(0, [camera.width, camera.height] * 2).astype(np.float64)
        visible = (drawn == number).sum() / max(cv2.contourArea(hull), 1.0)
        if one.name and visible >= LEAST_VISIBLE and (box[2:] - box[:2]).min() >= LEAST_PX:
            seen.append((one.name, box))
    return seen


def _outlined(pose: Pose) -> list[_Outlined]:
    """Every vehicle and sign ahead of the camera; those partly beside the camera have an empty name."""
    camera, location = pose.camera, LOCATIONS[pose.location]
    found = [_Outlined(STOP_SIGN, camera.project(sign.corners(sign_x(pose.lanes))), -camera.y)]
    for placed in traffic(location, pose.lanes, pose.density):
        points = _points(placed.model) + np.array([placed.x, placed.later(pose.distance), 0])
        nearest = camera.y + AHEAD_M
        if points[:, 1].max() > nearest:
            name = CLASSES[placed.model] if points[:, 1].min() > nearest else ""
            points[:, 1] = points[:, 1].clip(nearest)
            found.append(_Outlined(name, camera.project(points), points[:, 1].min() - camera.y))
    found += [
        _Outlined("traffic sign", camera.project(_corners(other)), other.y - camera.y)
        for other in other_signs(location, pose.lanes)
        if other.y > camera.y + AHEAD_M
    ]
    return found


def _corners(other: OtherSign) -> Array:
    """Corners [4, 3] in m of the rectangle around a sign."""
    wide, high = {"limit": (0.33, 0.33), "warning": (0.5, 0.5), "direction": (0.55, 0.25)}[other.kind]
    return np.array([(other.x + dx, other.y, other.z + dz) for dx in (-wide, wide) for dz in (-high, high)])


@cache
def _points(model: Model) -> NDArray[np.float32]:
    """Vertices [N, 3] in m of a vehicle at the origin."""
    return np.concatenate([mesh.vertices for mesh, _ in vehicle(model, PAINTS[0])])
