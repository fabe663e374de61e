"""What can be printed: bounds of reflectance, a printer's gamut, and the non-printability score."""

from __future__ import annotations

from functools import cache
from itertools import product

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavbench.detection.colour import linear, srgb

Array = NDArray[np.float64]

LEAST, MOST = 0.03, 0.85
"""Reflectance of the darkest and of the lightest print, in each of the three channels of linear sRGB."""
SOLIDS: dict[str, tuple[float, float, float]] = {
    "paper": (95, 0, -2),
    "cyan": (55, -37, -50),
    "magenta": (48, 74, -3),
    "yellow": (89, -5, 93),
    "red": (47, 68, 48),
    "green": (50, -65, 27),
    "blue": (24, 22, -46),
    "overprint": (23, 0, 0),
    "black": (16, 0, 0),
}
"""CIELAB (D50) of paper, solid inks and overprints: about the aims of ISO 12647-2:2004/Amd 1:2007 for coated paper."""
NEUTRAL = 0.2
"""Linear grey inside the gamut; a colour outside is moved towards it."""
_WHITE = np.array([0.96422, 1.0, 0.82521])
_FROM_XYZ = np.array(
    [
        [3.1338561, -1.6168667, -0.4906146],
        [-0.9787684, 1.9161415, 0.0334540],
        [0.0719453, -0.2289914, 1.4052427],
    ]
)
"""Linear sRGB from XYZ under D50, adapted by Bradford's transformation."""


@cache
def inks() -> dict[str, Array]:
    """Linear sRGB [3] of the `SOLIDS`, within `LEAST` and `MOST`."""
    return {name: np.clip(_FROM_XYZ @ _xyz(*lab), LEAST, MOST) for name, lab in SOLIDS.items()}


def _xyz(lightness: float, a: float, b: float) -> Array:
    """CIE 1976: XYZ of a CIELAB colour."""
    y = (lightness + 16) / 116
    root = np.array([y + a / 500, y, y - b / 200])
    return _WHITE * np.where(root > 6 / 29, root**3, 3 * (6 / 29) ** 2 * (root - 4 / 29))


@cache
def _facets() -> tuple[Tensor, Tensor]:
    """Normals [F, 3] and offsets [F] of the facets of the gamut: normal . colour + offset <= 0 inside.

    A halftone reflects the mean of the inks and overprints under it (Neugebauer 1937), so the gamut lies in their convex hull.
    """
    from scipy.spatial import ConvexHull

    equations = torch.from_numpy(ConvexHull(np.stack(list(inks().values()))).equations).float()
    return equations[:, :3], equations[:, 3]


def printed(texels: Tensor) -> Tensor:
    """The texels as a printer shows them: in linear light, colours outside the gamut move towards grey up to its border.

    Args:
        texels: sRGB in [0, 1], [..., 3, P, P]; differentiable in it.
    """
    normals, offsets = _facets()
    away = linear(texels) - NEUTRAL
    room = -(normals.sum(1) * NEUTRAL + offsets)
    reach = torch.einsum("fc,...chw->...fhw", normals / room[:, None], away).amax(-3, keepdim=True)
    return srgb(NEUTRAL + away / reach.clamp(min=1))


@cache
def triplets() -> Tensor:
    """Thirty printable colours [30, 3], sRGB: cyan, magenta and yellow at 0, 50 and 100 %, and black at 50, 75 and 100 %.

    Mixed as Neugebauer does, each overprint weighted by its area (Demichel).
    """
    found = inks()
    overprints = {
        (0, 0, 0): "paper", (1, 0, 0): "cyan", (0, 1, 0): "magenta", (0, 0, 1): "yellow",
        (0, 1, 1): "red", (1, 0, 1): "green", (1, 1, 0): "blue", (1, 1, 1): "overprint",
    }  # fmt: skip
    mixed = [
        sum(
            np.prod([share if inked else 1 - share for share, inked in zip(shares, which, strict=True)]) * found[name]
            for which, name in overprints.items()
        )
        for shares in product((0.0, 0.5, 1.0), repeat=3)
    ]
    mixed += [share * found["black"] + (1 - share) * found["paper"] for share in (0.5, 0.75, 1.0)]
    return srgb(torch.from_numpy(np.stack(mixed)).float())


def non_printability(texels: Tensor) -> Tensor:
    """Mean distance of the texels to the nearest of the `triplets`, in sRGB: the score of Sharif et al. (2016, section 5.2).

    They multiply the distances to all triplets; the nearest alone is the form of Thys et al. (2019, section 3.1).

    Args:
        texels: sRGB in [0, 1], [..., 3, P, P]; differentiable in it.
    """
    colours = texels.movedim(-3, -1).reshape(-1, 3)
    squares = (colours[:, None] - triplets()).square().sum(-1).amin(-1)
    return (squares + 1e-12).sqrt().mean()
