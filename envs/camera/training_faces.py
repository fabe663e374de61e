"""Faces of the decoys in the training scenes, drawn at random, so that none of the faces that are scored is learnt by heart."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cavbench.detection import Decoy
from cavbench.envs.camera import sign

Image = NDArray[np.uint8]
Colour = tuple[int, int, int]

LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789"
OUTLINES = ("octagon",) * 6 + ("disc",) * 4 + ("triangle",) * 2 + ("diamond", "rectangle", "nothing")
"""Drawn with equal probability."""
RED_GROUNDS = 0.35
"""Of the plates that are no octagons, this share is red inside, as a no-entry sign is. A red octagon may be a stop sign."""
WHITE_MARKS = 0.6
"""Of the marks on a red ground, this share is white, as on traffic signs."""
RED_RIMS = 0.35
"""Share of the plates with a red rim, as many signs have. A stop sign with a patch has one, too, but a wider one."""
WHITE: Colour = (235, 235, 230)
NAME = "training "
_SIDE = sign.TEXELS
_FULL = 255


def decoys(first: int, count: int) -> tuple[Decoy, ...]:
    """The training decoys with the numbers from `first` on."""
    names = (name(number) for number in range(first, first + count))
    return tuple(Decoy(one, octagonal=_begun(one)[1] == "octagon") for one in names)


def name(number: int) -> str:
    """The name of the training decoy of a number."""
    return f"{NAME}{number}"


def drawn(face: str) -> tuple[Image, Image]:
    """The face of a training decoy: colours sRGB [S, S, 3], and where its plate is [S, S], 0 to 255."""
    chance, outline = _begun(face)
    cover = np.zeros((_SIDE, _SIDE), np.uint8) if outline == "nothing" else polygon(outline, 1.0)
    rim = red(chance) if chance.random() < RED_RIMS else colour(chance)
    picture = np.full((_SIDE, _SIDE, 3), rim, np.uint8)
    inner = polygon(outline, chance.uniform(0.75, 0.97)) if outline != "nothing" else cover
    is_red = outline != "octagon" and chance.random() < RED_GROUNDS
    picture[inner > 0] = red(chance) if is_red else ground(chance)
    for _ in range(int(chance.integers(1, 4))):
        ink = WHITE if is_red and chance.random() < WHITE_MARKS else colour(chance)
        painting = (_word, _word, _shape, _bars, _blocks)
        painting[int(chance.integers(len(painting)))](picture, chance, ink)
    return picture, cover


def _begun(face: str) -> tuple[np.random.Generator, str]:
    """The random generator of a face, and its outline, which is drawn first."""
    chance = np.random.default_rng(int(face.removeprefix(NAME)))
    return chance, str(chance.choice(OUTLINES))


def polygon(outline: str, size: float) -> Image:
    """Where a centred plate of an outline is, its size as a share of the face's."""
    mask, middle, radius = np.zeros((_SIDE, _SIDE), np.uint8), _SIDE / 2, size * _SIDE / 2
    first, corners = {
        "octagon": (22.5, 8),
        "triangle": (90.0, 3),
        "diamond": (0.0, 4),
        "rectangle": (45.0, 4),
        "disc": (0.0, 64),
    }[outline]
    if outline == "octagon":
        radius /= np.cos(np.pi / 8)
    angles = np.deg2rad(first + 360 / corners * np.arange(corners))
    points = middle + radius * np.stack([np.cos(angles), np.sin(angles)], 1)
    cv2.fillPoly(mask, [points.round().astype(np.int32)], _FULL)
    return mask


def colour(chance: np.random.Generator) -> Colour:
    """White, black, or any hue."""
    match chance.choice(["white", "black", "hue"], p=[0.2, 0.1, 0.7]):
        case "white":
            return WHITE
        case "black":
            return (14, 14, 14)
    return _rgb(int(chance.integers(180)), int(chance.integers(90, 256)), int(chance.integers(70, 250)))


def red(chance: np.random.Generator) -> Colour:
    """A red of traffic signs, new or faded."""
    return _rgb(int(chance.integers(-6, 7)) % 180, int(chance.integers(170, 256)), int(chance.integers(110, 240)))


def _rgb(hue: int, saturation: int, value: int) -> Colour:
    """A colour; `hue` is in units of two degrees."""
    red, green, blue = cv2.cvtColor(np.array([[[hue, saturation, value]]], np.uint8), cv2.COLOR_HSV2RGB)[0, 0].tolist()
    return red, green, blue


def ground(chance: np.random.Generator) -> Colour:
    """A colour that is not the red of a stop sign."""
    while True:
        found = colour(chance)
        if found[0] < 1.8 * max(found[1:]):
            return found


def _word(picture: Image, chance: np.random.Generator, colour: Colour) -> None:
    """A word of up to six letters or digits."""
    text = "".join(chance.choice(list(LETTERS), size=int(chance.integers(1, 7))))
    font = int(chance.choice([cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_TRIPLEX]))
    share = chance.uniform(0.4, 0.9) * _SIDE
    thick = int(chance.uniform(0.01, 0.05) * _SIDE) + 1
    (wide, high), _ = cv2.getTextSize(text, font, 1.0, 1)
    scale = min(share / wide, 0.4 * _SIDE / high)
    x, y = _SIDE / 2 - scale * wide / 2, _SIDE * chance.uniform(0.35, 0.65) + scale * high / 2
    cv2.putText(picture, text, (round(x), round(y)), font, scale, colour, thick, cv2.LINE_AA)


def _shape(picture: Image, chance: np.random.Generator, colour: Colour) -> None:
    """A disc, a ring, a triangle, a diamond or a rectangle."""
    name = str(chance.choice(["octagon", "disc", "triangle", "diamond", "rectangle"]))
    size = chance.uniform(0.3, 0.9)
    mask = polygon(name, size) > 0
    if chance.random() < 0.5:
        mask &= polygon(name, size * chance.uniform(0.5, 0.85)) == 0
    picture[mask] = colour


def _bars(picture: Image, chance: np.random.Generator, colour: Colour) -> None:
    """Stripes across, down or aslant."""
    rows, columns = np.mgrid[:_SIDE, :_SIDE] / _SIDE
    angle = chance.choice([0.0, 0.25, 0.5, 0.75]) * np.pi
    along = np.cos(angle) * rows + np.sin(angle) * columns
    low = chance.uniform(-0.2, 0.9)
    picture[(along > low) & (along < low + chance.uniform(0.08, 0.3))] = colour


def _blocks(picture: Image, chance: np.random.Generator, colour: Colour) -> None:
    """A square of random blocks in the middle, fine or coarse, as patches of attacks are; of all colours."""
    cells, side = int(2 ** chance.uniform(1, 6)), int(chance.uniform(0.3, 0.6) * _SIDE)
    colours = chance.integers(0, 256, (cells, cells, 3), np.uint8)
    first = (_SIDE - side) // 2
    how = int(chance.choice([cv2.INTER_NEAREST, cv2.INTER_LINEAR]))
    picture[first : first + side, first : first + side] = cv2.resize(colours, (side, side), interpolation=how)
