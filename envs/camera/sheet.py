"""The sheet of faces: words, colours, real signs and foreign stop signs, half of each family kept back for scoring.

Shipped as one small picture, so that scoring needs no download. `studies/draw_faces.py` draws it. The real signs are of the npm
package mapillary_sprite_source (MIT, notice beside the picture), the letters are Overpass (OFL).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cavbench.detection import Decoy
from cavbench.files import whole

Image = NDArray[np.uint8]

SIDE = 128
"""Side of a face in texels; the largest sign that is scored is seen with fewer pixels."""
_PICTURE, _NAMES = (Path(__file__).parent / "data" / f"faces.{ending}" for ending in ("png", "json"))
_WIDE = 10


def half(*, scored: bool) -> tuple[Decoy, ...]:
    """The faces that are kept back for scoring, or those for training, family after family."""
    return tuple(
        Decoy(str(row["name"]), octagonal=bool(row["octagonal"]), family=str(row["family"]))
        for row in _rows()
        if row["scored"] == scored
    )


def drawn(name: str) -> tuple[Image, Image]:
    """A face of the sheet: colours sRGB [SIDE, SIDE, 3], and where its plate is [SIDE, SIDE], 0 to 255."""
    place = next(n for n, row in enumerate(_rows()) if row["name"] == name)
    down, across = (SIDE * part for part in divmod(place, _WIDE))
    cell = _picture()[down : down + SIDE, across : across + SIDE]
    return cell[..., 2::-1].copy(), cell[..., 3].copy()


def write(cells: Sequence[Image], rows: Sequence[Mapping[str, object]]) -> None:
    """Write the sheet: faces RGBA [SIDE, SIDE, 4], and what is said of each."""
    picture = np.zeros((-(-len(cells) // _WIDE) * SIDE, _WIDE * SIDE, 4), np.uint8)
    for place, cell in enumerate(cells):
        down, across = (SIDE * part for part in divmod(place, _WIDE))
        picture[down : down + SIDE, across : across + SIDE] = cell[..., [2, 1, 0, 3]]
    _, encoded = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    with whole(_PICTURE) as file:
        file.write(encoded.tobytes())
    with whole(_NAMES) as file:
        file.write(("[\n" + ",\n".join(json.dumps(row, ensure_ascii=False) for row in rows) + "\n]\n").encode())


@cache
def _rows() -> list[dict[str, object]]:
    rows: list[dict[str, object]] = json.loads(_NAMES.read_text("utf-8"))
    return rows


@cache
def _picture() -> Image:
    """The sheet, BGRA."""
    found = cv2.imread(str(_PICTURE), cv2.IMREAD_UNCHANGED)
    assert found is not None
    return np.asarray(found, np.uint8)
