"""The pessimist's attack: every car seems nearer and closing faster, at every step alike."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from cavbench.core.contracts import Access
from cavbench.driving import DrivingAttack, Oracle

Outlook = Literal["pessimist", "optimist"]


@dataclass(frozen=True, kw_only=True)
class Pessimist(DrivingAttack):
    """Shows every other car nearer along the road and closing faster, by the whole budget and at every step alike.

    It makes no queries. The error is the same share of the value at every step, so an estimator that averages over time does not
    remove it. The ego's own row is not changed. Distance: the perturbation set of the threat model.

    Args:
        outlook: `pessimist`: nearer and closing faster. `optimist`: farther away and closing more slowly.

    Shapes: observation [B, V, F] in, the same out.

    Raises:
        ValueError: if the world does not measure `x` and `vx`.
    """

    access: ClassVar[Access] = "oblivious"
    needs: ClassVar[tuple[str, ...]] = ("x", "vx")

    outlook: Outlook = "pessimist"

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        names = oracle.features.names
        if not {"x", "vx"} <= set(names):
            raise ValueError(f"the attack needs the features x and vx, the world measures {', '.join(names)}")
        x, vx = 1 + names.index("x"), 1 + names.index("vx")
        middle = (oracle.features.low[x - 1] + oracle.features.high[x - 1]) / 2
        place = observation[:, 1:, x] * oracle.features.half_range()[x - 1] + middle
        # A car level with the ego counts as ahead.
        towards = torch.where(place < 0, 1.0, -1.0) * (1 if self.outlook == "pessimist" else -1)
        shift = torch.zeros_like(observation)
        shift[:, 1:, x] = towards
        shift[:, 1:, vx] = towards
        return oracle.project(observation + shift * oracle.radius)
