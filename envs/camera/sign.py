"""The stop sign: its octagon, the texture of its face, and the place of a patch."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavbench.detection.colour import linear
from cavbench.detection.mount import Mount
from cavbench.envs.camera.camera import Array, Camera

Colour = tuple[float, float, float]
"""A number for each of red, green and blue."""

SQUARE = Mount()
SIZE_M = 1.2
"""Width across flats: 48 inches, the oversized R1-1 of the MUTCD (2009, table 2B-1)."""
HEIGHT_M = 2.7
"""Height of its middle above the road; the lower edge is at 7 feet (2.1 m) (MUTCD 2009, section 2A.18)."""
TEXELS = 512
"""Side of the texture of the face, which covers the bounding square of the octagon."""
RED, WHITE = (0.68, 0.08, 0.12), (0.94, 0.94, 0.92)
"""sRGB."""

_LETTER_HEIGHT, _STROKE, _LETTER_WIDTH, _GAP = 1 / 3, 0.05, 0.165, 0.05
"""As shares of the sign's side: letters are 16 of 48 inches high (Standard Highway Signs 2004, R1-1)."""


def corners(x: float) -> Array:
    """Corners [8, 3] in m of the octagon of a sign at `x`."""
    angle = np.deg2rad(22.5 + 45 * np.arange(8))
    radius = SIZE_M / 2 / np.cos(np.pi / 8)
    return np.stack([x + radius * np.cos(angle), np.zeros(8), HEIGHT_M + radius * np.sin(angle)], 1)


def box(x: float, camera: Camera) -> Array:
    """x0, y0, x1, y1 of the sign in pixels, [4], not clipped to the image."""
    return _bounds(camera.project(corners(x)))


def patch_box(share: float, x: float, camera: Camera, mount: Mount = SQUARE) -> Array:
    """x0, y0, x1, y1 in pixels, [4], of a patch of the budget `share`, not clipped to the image."""
    left, top, right, bottom = mount.bounds(share)
    edges = ((left, top), (right, top), (right, bottom), (left, bottom))
    where = [(x + (across - 0.5) * SIZE_M, 0, HEIGHT_M + (0.5 - down) * SIZE_M) for across, down in edges]
    return _bounds(camera.project(np.array(where)))


def _bounds(seen: Array) -> Array:
    return np.concatenate([seen.min(0), seen.max(0)])


def _square(share: float, x: float) -> Array:
    """Corners [4, 3] of a centred square whose side is `share` of the sign's side, clockwise from the top left."""
    half = share * SIZE_M / 2
    return np.array(
        [(x + half * across, 0, HEIGHT_M + half * up) for across, up in ((-1, 1), (1, 1), (1, -1), (-1, -1))]
    )


def pixel_to_face(x: float, camera: Camera) -> Array:
    """Homography [3, 3] from pixels to texture coordinates: (0, 0) is the top left corner, (1, 1) the bottom right one."""
    seen = camera.project(_square(1.0, x)).astype(np.float32)
    face = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32)
    return np.asarray(cv2.getPerspectiveTransform(seen, face), np.float64)


def inside(face: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Whether points [..., 2] of the unit square of the texture are on the octagon."""
    across, down = (np.abs(2 * face[..., axis] - 1) for axis in (0, 1))
    return (np.maximum(across, down) <= 1) & (across + down <= np.sqrt(2))


@cache
def _strokes() -> list[tuple[list[tuple[float, float]], bool]]:
    """Centre lines of S, T (two strokes), O and P in letter boxes of width and height 1, and whether each line is closed."""

    def arc(x: float, y: float, rx: float, ry: float, start: float, end: float) -> list[tuple[float, float]]:
        angles = np.deg2rad(np.linspace(start, end, 24))
        return [(x + rx * float(np.cos(a)), y + ry * float(np.sin(a))) for a in angles]

    s = arc(0.5, 0.26, 0.5, 0.26, -15, -180) + arc(0.5, 0.26, 0.5, 0.24, 180, 90)
    s += arc(0.5, 0.74, 0.5, 0.24, -90, 0) + arc(0.5, 0.74, 0.5, 0.26, 0, 165)
    o = arc(0.5, 0.3, 0.5, 0.3, -180, 0) + arc(0.5, 0.7, 0.5, 0.3, 0, 180)
    p = [(0.0, 1.0), (0.0, 0.0), (0.5, 0.0), *arc(0.55, 0.27, 0.45, 0.27, -90, 90), (0.0, 0.54)]
    return [(s, False), ([(0.0, 0.0), (1.0, 0.0)], False), ([(0.5, 0.0), (0.5, 1.0)], False), (o, True), (p, False)]


@cache
def face() -> NDArray[np.float32]:
    """The face of the stop sign [3, TEXELS, TEXELS], sRGB in [0, 1]. Cached: do not modify it."""
    scale = 4
    side = TEXELS * scale
    picture = np.empty((side, side, 3), np.float32)
    picture[:] = WHITE
    angle = np.deg2rad(22.5 + 45 * np.arange(8))
    radius = side / 2 / np.cos(np.pi / 8) * 0.955
    octagon = side / 2 + radius * np.stack([np.cos(angle), np.sin(angle)], 1)
    cv2.fillPoly(picture, [octagon.astype(np.int32)], RED)
    letters = (0, 1, 1, 2, 3)
    left = 0.5 - (4 * _LETTER_WIDTH + 3 * _GAP) / 2
    for (line, closed), letter in zip(_strokes(), letters, strict=True):
        points = np.array(line) * (_LETTER_WIDTH - _STROKE, _LETTER_HEIGHT - _STROKE) + _STROKE / 2
        points += (left + letter * (_LETTER_WIDTH + _GAP), 0.5 - _LETTER_HEIGHT / 2)
        thickness = round(_STROKE * side)
        cv2.polylines(picture, [(points * side).astype(np.int32)], closed, WHITE, thickness, cv2.LINE_AA)
    small = cv2.resize(picture, (TEXELS, TEXELS), interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(small.transpose(2, 0, 1))


def painted(patches: Tensor | None, share: float, printed: Colour = (1.0, 1.0, 1.0), mount: Mount = SQUARE) -> Tensor:
    """Linear reflectances of the face with patches, [N, 3, TEXELS, TEXELS]; each texel of a patch is a square.

    Args:
        patches: sRGB in [0, 1], [N, 3, P, P]; None for the plain face, N = 1.
        share: side of the patch as a share of the sign's side, in (0, 1].
        printed: what a print reflects as a share of what the sheeting reflects, for each colour; less than 1 in headlights.
        mount: how the patches are shown.
    """
    plain = _reflectance().unsqueeze(0)
    if patches is None:
        return plain
    return mount.painted(plain, patches, share, torch.tensor(printed).view(3, 1, 1))


@cache
def _reflectance() -> Tensor:
    """Linear reflectances of the plain face, [3, TEXELS, TEXELS]."""
    return linear(torch.from_numpy(face()))
