"""How much of the sign the traffic hides, estimated from outlines: for the layout of a street, not for scores."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from functools import cache

import cv2
import numpy as np

from cavbench.envs.camera import sign
from cavbench.envs.camera.camera import Array, Camera
from cavbench.envs.camera.street.vehicles import PAINTS, Model, vehicle

FINE = 4
"""Samples along the side of a pixel."""


def visible(camera: Camera, sign_x: float, vehicles: Iterable[tuple[Model, float, float]]) -> float:
    """Share of the sign that is inside the image and not hidden by a vehicle, in [0, 1].

    Args:
        camera: camera of the view.
        sign_x: x of the sign in m.
        vehicles: model, x and y of the middle in m.
    """
    outline = camera.project(sign.corners(sign_x))
    corner = outline.min(0) - 1
    width, height = (np.ceil((outline.max(0) - corner + 1) * FINE)).astype(int)

    def drawn(points: Array) -> np.ndarray:
        hull = cv2.convexHull(((points - corner) * FINE).astype(np.float32)).astype(np.int32)
        mask = np.zeros((height, width), np.uint8)
        cv2.fillConvexPoly(mask, hull, 1)
        return mask

    seen = drawn(outline)
    whole = seen.sum()
    column = np.arange(width) / FINE + corner[0]
    seen[:, (column < 0) | (column >= camera.width)] = 0
    for model, x, y in vehicles:
        points = _points(model) + np.array([x, y, 0])
        points[:, 1] = points[:, 1].clip(camera.y + 0.3)
        if points[:, 1].min() < 0 < points[:, 1].max() - camera.y - 0.3:
            seen[drawn(camera.project(points)) > 0] = 0
    return float(seen.sum() / whole)


@cache
def _points(model: Model) -> Array:
    """Corners [8, 3] in m of the box around a vehicle at the origin."""
    points = np.concatenate([mesh.vertices for mesh, _ in vehicle(model, PAINTS[0])])
    low, high = points.min(0), points.max(0)
    return np.array(list(itertools.product(*zip(low, high, strict=True))), float)
