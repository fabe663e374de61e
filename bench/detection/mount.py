"""How the texels of a patch come onto the sign: their place, and whether they are paper, stickers, light or a plate."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil
from typing import Literal

import torch
from torch import Tensor

from cavbench.detection.colour import linear

Shape = Literal["square", "stickers", "light", "plate"]
Place = Literal["middle", "top", "bottom", "beside"]
ASIDE = 0.25
"""Distance of the places `top` and `bottom` from the middle, as a share of the sign's side."""
GAP = 0.05
"""Between the sign and a plate beside it, as a share of the sign's side."""
Spot = tuple[float, float, float, float]
"""x0, y0, x1, y1 on the bounding square of the sign: (0, 0) is its top left corner, (1, 1) the bottom right one."""


@dataclass(frozen=True)
class Mount:
    """How a patch [3, P, P] of a budget b, a share of the sign's side, is shown.

    Args:
        shape: `square`: paper on a square of side b. `stickers`: the texels are cut into quarters, each on a square of side b / 2
            in the middle of a quarter of the sign, so that they cover as much as the one square (Eykholt et al. 2018). `light`: a
            projector adds at most b times the light that falls on the sign (Lovisotto et al. 2021). `plate`: a plate of side b on
            a post without a sign.
        place: of a square: in the middle of the sign, or a quarter of its side above or below, less where it would not fit; or
            `beside`: on a plate of its own left of the sign, at the same height, which covers nothing of the sign.
    """

    shape: Shape = "square"
    place: Place = "middle"

    @property
    def appears(self) -> bool:
        """Whether there is no sign below the patch."""
        return self.shape == "plate"

    @property
    def covers(self) -> bool:
        """Whether the patch hides a part of the sign."""
        return self.shape in ("square", "stickers") and self.place != "beside"

    def spots(self, share: float) -> tuple[Spot, ...]:
        """Where the patch is; on the bounding square of the sign what is beyond the octagon is cut off.

        Args:
            share: the budget.
        """
        if self.shape == "light":
            return ((0.0, 0.0, 1.0, 1.0),)
        if self.shape == "stickers":
            return tuple(_square(x, y, share / 2) for y in (0.25, 0.75) for x in (0.25, 0.75))
        if self.place == "beside":
            return (_square(-GAP - share / 2, 0.5, share),)
        aside = min(ASIDE, (1 - share) / 2)
        return (_square(0.5, {"top": 0.5 - aside, "middle": 0.5, "bottom": 0.5 + aside}[self.place], share),)

    def bounds(self, share: float) -> Spot:
        """The smallest rectangle around the `spots`."""
        left, top, right, bottom = zip(*self.spots(share), strict=True)
        return min(left), min(top), max(right), max(bottom)

    def painted(self, plain: Tensor, patches: Tensor, share: float, printed: Tensor) -> Tensor:
        """Linear reflectances of the sign's face with patches, [N, 3, S, S]; each texel is a square.

        Args:
            plain: linear reflectances of the face without a patch, [1, 3, S, S].
            patches: sRGB in [0, 1], [N, 3, P, P]; differentiable in it.
            share: the budget.
            printed: what a print reflects as a share of what the sheeting reflects, [3, 1, 1].
        """
        size = plain.shape[-1]
        if self.shape == "light":
            # The sign reflects added light as it reflects all light.
            return plain * (1 + share * _scaled(linear(patches), size, size))
        light = linear(patches) * printed
        spots = [_texels(spot, size) for spot in self.spots(share)]
        parts = [light] if len(spots) == 1 else [half for row in light.chunk(2, -2) for half in row.chunk(2, -1)]
        faces = plain.repeat(len(patches), 1, 1, 1)
        for (rows, columns), part in zip(spots, parts, strict=True):
            faces[:, :, rows, columns] = _scaled(part, rows.stop - rows.start, columns.stop - columns.start)
        return faces

    def cover(self, share: float, size: int) -> Tensor:
        """[1, S, S] what of the bounding square the patch covers: 1, else 0."""
        found = torch.zeros(1, size, size)
        for spot in self.spots(share):
            rows, columns = _texels(spot, size)
            found[:, rows, columns] = 1.0
        return found


def _square(x: float, y: float, side: float) -> Spot:
    return x - side / 2, y - side / 2, x + side / 2, y + side / 2


def _texels(spot: Spot, size: int) -> tuple[slice, slice]:
    """Rows and columns of a face of `size` texels that a spot covers."""
    left, top, right, bottom = spot
    return _range(top, bottom, size), _range(left, right, size)


def _range(start: float, end: float, size: int) -> slice:
    side = max(1, round((end - start) * size))
    # An odd number of texels lies half a texel before the middle.
    first = ceil((start + end) / 2 * size - side / 2 - 0.75)
    first = min(max(first, 0), size - side)
    return slice(first, first + side)


def _scaled(light: Tensor, height: int, width: int) -> Tensor:
    return torch.nn.functional.interpolate(light, size=(height, width), mode="nearest-exact")
