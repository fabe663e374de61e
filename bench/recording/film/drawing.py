"""Drawing on pictures: text, boxes with subpixel positions, colours that colour-blind readers can tell apart."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from cavbench.recording.film.film import PAPER, Picture

Colour = tuple[int, int, int]

# The palette of Okabe and Ito (2008), "Color Universal Design".
BLACK: Colour = (32, 34, 38)
GREY: Colour = (110, 114, 120)
PALE: Colour = (205, 208, 212)
ROAD: Colour = (236, 237, 239)
ORANGE: Colour = (230, 159, 0)
SKY: Colour = (86, 180, 233)
GREEN: Colour = (0, 158, 115)
BLUE: Colour = (0, 114, 178)
VERMILLION: Colour = (213, 94, 0)
PURPLE: Colour = (204, 121, 167)
DARK: Colour = (84, 88, 94)
TINT: Colour = (240, 178, 142)
"""A light vermillion. Vermillion stands for the attack and for nothing else."""
CYCLE: tuple[Colour, ...] = (PURPLE, PALE, ORANGE, BLUE, DARK, GREEN, SKY)
"""Colours of actions, by number."""

SHIFT = 4
"""Bits of OpenCV's subpixel coordinates."""
EAST = np.array([1.0, 0.0])
"""The direction of a box along the picture."""


def blank(height: int, width: int) -> Picture:
    """A picture of paper."""
    return np.full((height, width, 3), PAPER, np.uint8)


@lru_cache(maxsize=4096)
def _letters(text: str, size: int) -> NDArray[np.float32]:
    """How much ink each pixel has, [height, width] in [0, 1]."""
    font = ImageFont.load_default(size)
    left, _, right, _ = font.getbbox(text)
    ascent, descent = font.getmetrics()  # type: ignore[union-attr]
    image = Image.new("L", (max(1, round(right - left)) + 2, ascent + descent))
    ImageDraw.Draw(image).text((-left, 0), text, fill=255, font=font)
    return (np.asarray(image) / 255).astype(np.float32)


def write(
    picture: Picture,
    text: str,
    x: float,
    y: float,
    *,
    size: int = 16,
    colour: Colour = BLACK,
    align: Literal["left", "centre", "right"] = "left",
) -> None:
    """Write one line; (x, y) is its left, centre or right end at half its height. What does not fit is cut off."""
    ink = _letters(text, size)
    height, width = ink.shape
    left = round(x - {"left": 0, "centre": width / 2, "right": width}[align])
    top = round(y - height / 2)
    rows, columns = slice(max(top, 0), top + height), slice(max(left, 0), left + width)
    under = picture[rows, columns]
    kept = ink[max(-top, 0) :, max(-left, 0) :][: under.shape[0], : under.shape[1], None]
    under[:] = (under * (1 - kept) + np.array(colour, np.float32) * kept).astype(np.uint8)


def box(
    picture: Picture,
    x: float,
    y: float,
    half: tuple[float, float],
    colour: Colour,
    outline: float = 0.0,
    towards: NDArray[np.float64] = EAST,
) -> None:
    """A box around (x, y) in pixels: filled, or with an outline of so many pixels; `towards` [2] is where its length points."""
    forward, side = half[0] * towards, half[1] * np.array([-towards[1], towards[0]])
    corners = np.array([x, y]) + np.stack([-forward - side, forward - side, forward + side, -forward + side])
    points = np.rint(corners * 2**SHIFT).astype(np.int32)
    if outline:
        cv2.polylines(picture, [points], True, colour, round(outline), cv2.LINE_AA, SHIFT)
    else:
        cv2.fillPoly(picture, [points], colour, cv2.LINE_AA, SHIFT)


def stroke(picture: Picture, places: Sequence[tuple[float, float]], colour: Colour, width: int) -> None:
    """A line through places in pixels, with round corners."""
    points = np.rint(np.array(places) * 2**SHIFT).astype(np.int32)
    cv2.polylines(picture, [points], False, colour, width, cv2.LINE_AA, SHIFT)


def line(
    picture: Picture, start: tuple[float, float], end: tuple[float, float], colour: Colour, width: int = 1
) -> None:
    """A line between two points in pixels."""
    first, last = (tuple(int(np.rint(value * 2**SHIFT)) for value in point) for point in (start, end))
    cv2.line(picture, first, last, colour, width, cv2.LINE_AA, SHIFT)
