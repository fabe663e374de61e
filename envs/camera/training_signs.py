"""Faces of training decoys that are like signs: words on red octagons, the training half of the sheet, and foreign stop signs.

A detector that never sees another word on a red octagon learns the octagon, the rim and "something white", not the word.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from cavbench.detection import Decoy
from cavbench.detection.scenes import FAMILIES, FOREIGN
from cavbench.envs.camera import sheet, sign, training_faces

Image = NDArray[np.uint8]
Colour = tuple[int, int, int]

KINDS = {"drawn": 0.25, "word": 0.3, "sheet": 0.3, "stop": 0.15}
"""How often a face is drawn at random (`training_faces`), a new word, of the sheet's training half, or a foreign stop sign."""
RED_OCTAGONS = 0.75
"""Share of the new words that are white on a red octagon; the others are on an octagon of another colour."""
LIKE_STOP = 0.5
"""Share of the new words that keep letters of STOP at their places."""
NAME = "signs "
_LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
_SIDE = sign.TEXELS


def decoys(first: int, count: int) -> tuple[Decoy, ...]:
    """The training decoys with the numbers from `first` on."""
    return tuple(_decoy(f"{NAME}{number}") for number in range(first, first + count))


def drawn(name: str) -> tuple[Image, Image]:
    """The face of a training decoy: colours sRGB [S, S, 3], and where its plate is [S, S], 0 to 255."""
    chance, kind, original = _begun(name)
    match kind:
        case "drawn":
            return training_faces.drawn(training_faces.name(int(name.removeprefix(NAME))))
        case "word":
            return _worded(chance)
    assert original is not None
    picture, cover = sheet.drawn(original.name)
    return _faded(picture, chance), cover


def _decoy(name: str) -> Decoy:
    chance, kind, original = _begun(name)
    if original is not None:
        return Decoy(name, octagonal=original.octagonal, family=original.family)
    if kind == "word":
        return Decoy(name, octagonal=True, family="words" if chance.random() < RED_OCTAGONS else "colours")
    (other,) = training_faces.decoys(int(name.removeprefix(NAME)), 1)
    return Decoy(name, octagonal=other.octagonal)


def _begun(name: str) -> tuple[np.random.Generator, str, Decoy | None]:
    """The random generator of a face, its kind, and the face of the sheet that it shows, if any."""
    chance = np.random.default_rng([int(name.removeprefix(NAME)), 1])
    kind = str(chance.choice(list(KINDS), p=list(KINDS.values())))
    if kind not in ("sheet", "stop"):
        return chance, kind, None
    family = FOREIGN if kind == "stop" else str(chance.choice(FAMILIES))
    own = [one for one in sheet.half(scored=False) if one.family == family]
    return chance, kind, own[int(chance.integers(len(own)))]


def _worded(chance: np.random.Generator) -> tuple[Image, Image]:
    """A word on an octagon with a rim."""
    red = chance.random() < RED_OCTAGONS
    ground = training_faces.red(chance) if red else training_faces.ground(chance)
    ink = training_faces.WHITE if red or chance.random() < 0.6 else training_faces.colour(chance)
    picture = np.full((_SIDE, _SIDE, 3), ink, np.uint8)
    picture[training_faces.polygon("octagon", chance.uniform(0.9, 0.98)) > 0] = ground
    mask = _lettered(new_word(chance), chance)
    down, across = ((_SIDE - side) // 2 for side in mask.shape)
    here = picture[down : down + mask.shape[0], across : across + mask.shape[1]]
    share = mask[..., None] / 255
    here[:] = (share * np.array(ink) + (1 - share) * here).round().astype(np.uint8)
    return picture, np.full((_SIDE, _SIDE), 255, np.uint8)


def new_word(chance: np.random.Generator) -> str:
    """A word of two to six letters that is no stop word, and is not kept back."""
    while True:
        if chance.random() < LIKE_STOP:
            letters = list("STOP")
            for place in chance.choice(4, size=int(chance.integers(2, 4)), replace=False):
                letters[place] = str(chance.choice(list(_LETTERS)))
        else:
            letters = list(chance.choice(list(_LETTERS), size=int(chance.integers(2, 7))))
        if (word := "".join(letters)) not in _taken():
            return word


@cache
def _taken() -> frozenset[str]:
    """The words of the sheet, and STOP."""
    names = [one.name for scored in (False, True) for one in sheet.half(scored=scored)]
    return frozenset({"STOP", *(name.rpartition(" ")[2] for name in names)})


def _lettered(text: str, chance: np.random.Generator) -> Image:
    """White letters on black, [h, w], as high and wide as words on signs are."""
    canvas = np.zeros((300, 200 * len(text) + 200, 3), np.uint8)
    if chance.random() < 0.6:
        letters = cv2.FontFace(str(chance.choice(["sans", "italic"], p=[0.8, 0.2])))
        cv2.putText(canvas, text, (50, 220), (255, 255, 255), letters, 180, int(chance.integers(400, 901)))
    else:
        kind = int(chance.choice([cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_TRIPLEX]))
        cv2.putText(canvas, text, (50, 220), kind, 6.0, (255, 255, 255), int(chance.integers(14, 34)), cv2.LINE_AA)
    rows, columns = (np.flatnonzero(canvas[..., 0].any(axis)) for axis in (1, 0))
    mask = canvas[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1, 0]
    high = chance.uniform(0.22, 0.38) * _SIDE
    wide = min(high * mask.shape[1] / mask.shape[0], chance.uniform(0.7, 0.82) * _SIDE)
    return np.asarray(cv2.resize(mask, (round(wide), round(high)), interpolation=cv2.INTER_AREA), np.uint8)


def _faded(picture: Image, chance: np.random.Generator) -> Image:
    """A face with somewhat other colours: print, age and dirt."""
    gain, lift = chance.uniform(0.92, 1.06, 3) * chance.uniform(0.85, 1.1), chance.uniform(0, 25)
    return np.asarray((picture * gain + lift).clip(0, 255), np.uint8)
