"""The threat model of the detection track: the perturbation set, and the projection onto it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import torch
from annotated_types import Interval
from torch import Tensor

from cavbench.core.contracts import ThreatModel
from cavbench.core.ranges import Natural
from cavbench.detection.mount import Mount, Place, Shape
from cavbench.detection.printing import printed
from cavbench.errors import UserError
from cavbench.scenarios import Axes, Cell

Knows = Literal["universal", "site", "scene"]
HIDING = ("shape=square", "shape=stickers", "shape=light")
"""What an attack that hides a sign needs of a threat model (`Attack.forges`): that there is one."""
SIDES = range(8, 513)
"""Allowed width and height of a patch in texels."""
GREY = 0.5
"""Replacement for texels that are NaN or infinite."""


Texels = Annotated[int, Interval(ge=SIDES[0], le=SIDES[-1])]
"""The type of a parameter for the width and height of a patch in texels."""


@dataclass(frozen=True, kw_only=True)
class PatchThreat(ThreatModel):
    """The threat model of the detection track.

    Args:
        norm: `patch`: any texels on a square in the middle of the sign, no change elsewhere. `print`: only colours that a printer
            can put there (`cavbench.detection.printing`).
        budget: side of the square as a share of the sign's side, in (0, 1]; 0 only with 0 queries, for runs without attack.
        queries: largest number of queries (images) for crafting one patch.
        knows: the frames that a patch is crafted on. `universal`: those of the training places, none of which is scored. `site`:
            those of the very approach that is scored, in every weather: one patch for each approach. `scene`: those of the
            approach in its weather.
        shape, place: how the texels come onto the sign (`cavbench.detection.mount.Mount`). With another shape than a square the
            budget is that of the shape.
    """

    marks: ClassVar[tuple[str, ...]] = ("knows", "shape", "place")

    norm: Literal["patch", "print"] = "patch"
    budget: float = 0.5
    queries: Natural = 20_000
    knows: Knows = "universal"
    shape: Shape = "square"
    place: Place = "middle"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.budget <= 1 and (self.budget, self.queries) != (0, 0):
            raise ValueError(f"threat.budget must be in (0, 1], a share of the sign's side, got {self.budget}")

        if self.shape != "square" and self.place != "middle":
            raise ValueError(f"threat.place={self.place} is for squares: leave it out with threat.shape={self.shape}")

    @property
    def mount(self) -> Mount:
        """How the texels come onto the sign."""
        return Mount(self.shape, self.place)

    def lacks(self, world: Any, victim: Any) -> str:
        if self.mount == Mount() or world.mounts:
            return ""
        return "it shows patches as squares in the middle of the sign alone: leave out threat.shape and threat.place"

    def known(self, cell: Cell, axes: Axes) -> Cell | None:
        match self.knows:
            case "universal":
                return None
            case "site":
                return axes.looked_at(axes.unperceived(cell))
            case "scene":
                return axes.looked_at(cell)

    def confine(self, texels: Tensor) -> Tensor:
        """The allowed texels for texels [..., 3, P, P] without NaN: clipped to [0, 1], and printable with norm `print`."""
        clipped = texels.clamp(0, 1)
        return printed(clipped) if self.norm == "print" else clipped

    def project(self, texels: Tensor) -> tuple[Tensor, float]:
        """The patch to render, float32, and the largest distance from `texels` to it.

        Args:
            texels: [3, P, P]; they are confined to the perturbation set, NaN and infinite values become grey.

        Raises:
            UserError: if the shape is wrong, or its numbers are complex.
        """
        if (
            texels.ndim != 3
            or texels.shape[0] != 3
            or texels.shape[1] != texels.shape[2]
            or texels.shape[1] not in SIDES
        ):
            wanted = f"[3, P, P] with P from {SIDES[0]} to {SIDES[-1]}"
            raise UserError(f"a patch must be {wanted}, the attack made one of {list(texels.shape)}")
        if texels.is_complex():
            raise UserError("a patch must be of real numbers, the attack made one of complex ones")
        given = texels.detach().to("cpu", torch.float32)
        given = torch.where(given.isnan(), GREY, given)
        patch = self.confine(torch.where(given.isinf(), GREY, given))
        return patch, float((given - patch).abs().where(given.isfinite(), 0).max())
