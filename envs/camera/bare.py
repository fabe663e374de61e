"""A frame without the sign: the background behind it, which was not rendered, is filled in from its surroundings."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import cv2
import numpy as np
from numpy.typing import NDArray

from cavbench.envs.camera import sign
from cavbench.envs.camera.camera import Array, Camera

POST_M, POST_TOP_M, POST_Y = 0.035, sign.HEIGHT_M + 0.5, 0.05
"""Radius, height and y of the post in m."""
_BELOW_M = sign.HEIGHT_M - sign.SIZE_M / 2 - 0.15
"""A height at which the post is seen below the sign."""
_MARGIN, _RADIUS = 24, 4
"""Pixels around the sign that are filled in from, and the radius of the filling."""

Picture = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Post:
    """The post in an image.

    Args:
        top, below: pixels [2] of its upper end and of a point below the sign.
        half: half of its width in pixels.
    """

    top: Array
    below: Array
    half: float


def post_of(camera: Camera, x: float) -> Post:
    """Where the post of a sign at `x` in m is in the image of a camera."""
    top, below, edge = camera.project(
        np.array([(x, POST_Y, POST_TOP_M), (x, POST_Y, _BELOW_M), (x + POST_M, POST_Y, _BELOW_M)])
    )
    return Post(top, below, float(edge[0] - below[0]))


def without_sign(picture: Picture, crop: tuple[int, int, int, int], shown: NDArray[np.bool_], post: Post) -> Picture:
    """The crop [h, w, 3] of a picture [H, W, 3] without the sign, the post's upper part drawn in.

    Args:
        picture: the whole frame.
        crop: box around the sign in pixels.
        shown: [h, w], the pixels of the crop that show the sign.
        post: where the post is.
    """
    x0, y0, x1, y1 = crop
    left, top = max(x0 - _MARGIN, 0), max(y0 - _MARGIN, 0)
    around = picture[top : y1 + _MARGIN, left : x1 + _MARGIN].copy()
    hidden = np.zeros(around.shape[:2], np.uint8)
    hidden[y0 - top : y1 - top, x0 - left : x1 - left] = shown
    # The pixels beside the sign are still mixed with it.
    filled = cv2.inpaint(around, cv2.dilate(hidden, np.ones((3, 3), np.uint8)), _RADIUS, cv2.INPAINT_TELEA)
    here = filled[y0 - top : y1 - top, x0 - left : x1 - left].astype(np.uint8)
    _draw_post(here, picture, (x0, y0), shown, post)
    return here


def _draw_post(here: Picture, picture: Picture, corner: tuple[int, int], shown: NDArray[np.bool_], post: Post) -> None:
    """Continue the post upwards over the pixels `shown` of the crop, in place, with its pixels below the sign."""
    half, source = ceil(post.half), round(float(post.below[1]))
    lean = (post.top[0] - post.below[0]) / (post.top[1] - post.below[1])
    first = round(float(post.below[0])) - half
    if not (0 <= source < picture.shape[0] and first >= 0 and first + 2 * half < picture.shape[1]):
        return
    profile = picture[source, first : first + 2 * half + 1]
    for row in range(max(0, round(float(post.top[1])) - corner[1]), len(here)):
        middle = post.below[0] + lean * (row + corner[1] - post.below[1])
        columns = np.arange(2 * half + 1) + round(float(middle)) - half - corner[0]
        drawn = [(at, n) for n, at in enumerate(columns) if 0 <= at < here.shape[1] and shown[row, at]]
        for at, n in drawn:
            here[row, at] = profile[n]
