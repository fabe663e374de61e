"""What a patch attacker may change: the perturbation set, and the projection onto it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from annotated_types import Interval
from torch import Tensor

from bench.errors import UserError
from bench.plugins.contracts import ThreatModel
from bench.plugins.ranges import Natural

SIDES = range(8, 513)
"""Texels a patch may be wide and high."""
GREY = 0.5
"""What a texel that is no number becomes."""


Texels = Annotated[int, Interval(ge=SIDES[0], le=SIDES[-1])]
"""The type of a parameter that says how many texels wide and high a patch is."""


@dataclass(frozen=True, kw_only=True)
class PatchThreat(ThreatModel):
    """The threat model of the detection track.

    Args:
        norm: `patch`: any texels on a square in the middle of the sign, nothing elsewhere.
        budget: side of the square as a share of the sign's, in (0, 1]; 0 with no queries is nobody's.
        queries: most pictures the detector is asked about while a patch is crafted, all together.
    """

    norm: Literal["patch"] = "patch"
    budget: float = 0.5
    queries: Natural = 20_000

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.budget <= 1 and (self.budget, self.queries) != (0, 0):
            raise ValueError(f"threat.budget must be in (0, 1], a share of the sign's side, got {self.budget}")

    def project(self, texels: Tensor) -> tuple[Tensor, float]:
        """The patch that is shown, float32, and how far the texels given were outside [0, 1].

        Args:
            texels: [3, P, P]; what is out of range is clipped, what is no number becomes grey.

        Raises:
            UserError: if the shape is another.
        """
        if (
            texels.ndim != 3
            or texels.shape[0] != 3
            or texels.shape[1] != texels.shape[2]
            or texels.shape[1] not in SIDES
        ):
            wanted = f"[3, P, P] with P from {SIDES[0]} to {SIDES[-1]}"
            raise UserError(f"a patch must be {wanted}, the attack made one of {list(texels.shape)}")
        given = texels.detach().to("cpu", torch.float32)
        given = torch.where(given.isnan(), GREY, given)
        patch = torch.where(given.isinf(), GREY, given.clamp(0, 1))
        return patch, float((given - patch).abs().where(given.isfinite(), 0).max())
