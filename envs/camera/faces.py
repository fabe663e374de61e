"""Decoys: other faces that the post can carry instead of the stop sign, painted like a patch, so nothing is rendered again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavbench.detection import Decoy
from cavbench.detection.colour import linear
from cavbench.detection.scenes import FAMILIES, FOREIGN
from cavbench.envs.camera import sheet, sign, training_faces, training_signs

DECOYS = (
    Decoy("fifty", octagonal=True),
    Decoy("yield", octagonal=False),
    Decoy("cafe", octagonal=True),
    Decoy("limit", octagonal=False),
    Decoy("blank", octagonal=True),
    Decoy("nothing", octagonal=False),
    Decoy("advert", octagonal=True),
)
"""A speed limit on the octagon, a yield sign, a word on a yellow octagon, a round speed limit, a plain octagon, a post without
a sign, and an advert on the octagon; every second face has the outline of the stop sign."""

KINDS = (*FAMILIES, FOREIGN)

Image = NDArray[np.uint8]
Colour = tuple[int, int, int]
_SIDE = 4 * sign.TEXELS
"""Faces are drawn four times as large and averaged down."""
_RED, _WHITE, _BLACK = (190, 15, 25), (235, 235, 230), (12, 12, 12)
_YELLOW, _NAVY, _BLUE, _ORANGE = (242, 210, 25), (25, 30, 100), (40, 107, 190), (242, 122, 25)
"""sRGB, 0 to 255; the plate of a decoy is drawn with `_FULL`."""
_FULL = 255


@dataclass(frozen=True, eq=False)
class Face:
    """The face of a decoy on the bounding square of the stop sign.

    Args:
        reflectance: linear, [3, TEXELS, TEXELS].
        cover: [1, TEXELS, TEXELS], 1 where the plate is and 0 where the background shows, in [0, 1].
    """

    reflectance: Tensor
    cover: Tensor


def of_sheet(seed: int, count: int, *, scored: bool = True) -> tuple[Decoy, ...]:
    """Faces of a half of the sheet for the frames of an approach: the families take turns, in an order of the seed."""
    chance = np.random.default_rng(seed)
    half = sheet.half(scored=scored)
    own = {kind: chance.permutation([n for n, one in enumerate(half) if one.family == kind]) for kind in KINDS}
    order = chance.permutation(KINDS)
    turns = [(str(order[number % len(KINDS)]), number // len(KINDS)) for number in range(count)]
    return tuple(half[own[kind][turn % len(own[kind])]] for kind, turn in turns)


@lru_cache(maxsize=64)
def face(name: str) -> Face:
    """The face of a decoy, of `DECOYS`, of the sheet or for training. Cached: do not modify it."""
    picture, cover = _drawn(name)
    colour, shape = (
        torch.from_numpy(cv2.resize(part, (sign.TEXELS, sign.TEXELS), interpolation=cv2.INTER_AREA)) / 255
        for part in (picture, cover)
    )
    return Face(linear(colour.permute(2, 0, 1)), shape[None])


def _drawn(name: str) -> tuple[Image, Image]:
    if name in _DRAWN:
        return _DRAWN[name]()
    for source in (training_faces, training_signs):
        if name.startswith(source.NAME):
            return source.drawn(name)
    return sheet.drawn(name)


def _plain(colour: Colour) -> Image:
    return np.full((_SIDE, _SIDE, 3), colour, np.uint8)


def _cover(full: int) -> Image:
    return np.full((_SIDE, _SIDE), full, np.uint8)


def _written(picture: Image, text: str, height: float, colour: Colour) -> Image:
    """Write a text in the middle of a picture; `height` of its capitals as a share of the side."""
    font, thick = cv2.FONT_HERSHEY_DUPLEX, round(0.2 * height * _SIDE)
    scale = height * _SIDE / cv2.getTextSize("E", font, 1.0, 1)[0][1]
    (wide, high), _ = cv2.getTextSize(text, font, scale, thick)
    corner = (_SIDE - wide) // 2, (_SIDE + high) // 2
    cv2.putText(picture, text, corner, font, scale, colour, thick, cv2.LINE_AA)
    return picture


def _limit() -> tuple[Image, Image]:
    """A speed limit of 50 (Vienna Convention, C,14): a disc whose corners are not part of the plate."""
    picture, cover = _plain(_WHITE), _cover(0)
    middle, radius = (_SIDE // 2, _SIDE // 2), _SIDE // 2
    cv2.circle(cover, middle, radius, _FULL, -1)
    cv2.circle(picture, middle, round(0.86 * radius), _RED, round(0.2 * radius), cv2.LINE_AA)
    return _written(picture, "50", 0.34, _BLACK), cover


def _fifty() -> tuple[Image, Image]:
    picture, _ = _limit()
    return picture, _cover(_FULL)


def _yield() -> tuple[Image, Image]:
    """A triangle that stands on a corner (Vienna Convention, B,1)."""
    picture, cover = _plain(_RED), _cover(0)
    for size, drawn, colour in ((1.0, cover, (_FULL,) * 3), (0.58, picture, _WHITE)):
        angle = np.deg2rad([90.0, 210.0, 330.0])
        rim = _SIDE * (0.42 + 0.54 * size * np.stack([np.cos(angle), np.sin(angle)], 1) + np.array([0.08, 0.0]))
        cv2.fillPoly(drawn, [rim.astype(np.int32)], colour)
    return picture, cover


def _cafe() -> tuple[Image, Image]:
    return _written(_plain(_YELLOW), "CAFE", 0.21, _NAVY), _cover(_FULL)


def _advert() -> tuple[Image, Image]:
    picture = _plain(_BLUE)
    cv2.circle(picture, (round(0.66 * _SIDE), round(0.36 * _SIDE)), round(0.2 * _SIDE), _ORANGE, -1)
    cv2.rectangle(picture, (0, round(0.66 * _SIDE)), (_SIDE, _SIDE), _WHITE, -1)
    return _written(picture, "SALE", 0.17, _WHITE), _cover(_FULL)


_DRAWN: dict[str, Callable[[], tuple[Image, Image]]] = {
    "fifty": _fifty,
    "yield": _yield,
    "cafe": _cafe,
    "limit": _limit,
    "blank": lambda: (_plain(_WHITE), _cover(_FULL)),
    "nothing": lambda: (_plain(_WHITE), _cover(0)),
    "advert": _advert,
}
