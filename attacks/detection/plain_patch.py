"""A plain patch in one colour: a control, as some colours hide more of a sign than grey and noise do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from cavbench.core.contracts import Access, Progress
from cavbench.detection import PatchAttack, PatchOracle, Scenes

COLOURS = {
    "black": (0.0, 0.0, 0.0),
    "blue": (0.0, 0.0, 1.0),
    "red": (1.0, 0.0, 0.0),
    "green": (0.0, 1.0, 0.0),
    "white": (1.0, 1.0, 1.0),
}
"""sRGB."""


@dataclass(frozen=True, kw_only=True)
class PlainPatch(PatchAttack):
    """A patch of one colour, with norm `print` the nearest that can be printed.

    Args:
        colour: its name (default black).
    """

    access: ClassVar[Access] = "oblivious"
    seeded: ClassVar[bool] = False

    colour: Literal["black", "blue", "red", "green", "white"] = "black"

    def craft(self, oracle: PatchOracle, scenes: Scenes, progress: Progress) -> Tensor:
        return torch.tensor(COLOURS[self.colour])[:, None, None].expand(3, 8, 8).clone()
