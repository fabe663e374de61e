"""Random noise: the baseline for every attack."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import torch
from annotated_types import Interval
from torch import Tensor

from cavbench.core.contracts import Access
from cavbench.core.ranges import Natural
from cavbench.driving import DrivingAttack

if TYPE_CHECKING:
    from cavbench.driving import Oracle

Distribution = Literal["uniform", "gaussian"]


@dataclass(frozen=True, kw_only=True)
class Noise(DrivingAttack):
    """Random noise within the budget, without queries.

    Distance: the perturbation set of the threat model; `scale` is a share of its radius, for each feature.

    Args:
        distribution: `uniform` over the whole set, or `gaussian` with a standard deviation of `scale` times the radius,
            clipped to the set (default uniform).
        scale: width of the noise as a share of the radius, in (0, 1] (default 1).
        draw: number of the random draw: another number is other noise of the same kind.

    Shapes: observation [B, V, F] in, the same out.

    Example:
        >>> from cavbench.attacks.driving.noise import Noise
        >>> Noise(distribution="gaussian", scale=0.5).scale
        0.5
    """

    access: ClassVar[Access] = "oblivious"
    joint: ClassVar[bool] = True

    distribution: Distribution = "uniform"
    scale: Annotated[float, Interval(gt=0, le=1)] = 1.0
    draw: Natural = 0

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        own = [(observation[part.rows].shape, part.generator) for part in oracle.parts]
        if self.distribution == "uniform":
            share = torch.cat([torch.rand(shape, generator=generator) for shape, generator in own]) * 2 - 1
        else:
            share = torch.cat([torch.randn(shape, generator=generator) for shape, generator in own])
        return oracle.project(observation + self.scale * share * oracle.radius)
