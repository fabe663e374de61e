"""The interval of true values behind each shown value, for an assumed perturbation set."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from cavbench.driving.features import Features
from cavbench.driving.threat import Norm

ALONG = ("x", "vx")
"""The features along the road."""


class Boxes(NamedTuple):
    """What is known about every row of an observation, in physical units.

    Args:
        present: bool [..., V].
        low, high: bounds of the measured features, [..., V, F - 1]; infinite where the sensor's range ends.
    """

    present: Tensor
    low: Tensor
    high: Tensor


@dataclass(frozen=True)
class Assumed:
    """A perturbation set that a defence assumes; the true one is not known to it.

    Args:
        features: names, ranges and floors of the measured features.
        norm: kind of the set, as in `cavbench.driving.ObservationThreat`.
        budget: its size.
        noise: by how much the sensor may besides be wrong about where along the road another car is, and how fast, in m and
            m/s, at least 0.
    """

    features: Features
    norm: Norm
    budget: float
    noise: float = 0.0

    def boxes(self, shown: Tensor) -> Boxes:
        """The true values from which the set leads to the shown ones: the inverse of `ObservationThreat.radius`.

        With the norm `relative` a shown z stands for true values in [min(z - f, z / (1 +- b)), max(z + f, z / (1 -+ b))], where
        b is the budget and f the floor, and + or - is chosen by the sign of z. Boxes of other cars are wider by the noise at
        both ends; the ego's own row is measured without any.

        Args:
            shown: the observation that the policy received, [..., V, F], on the normalised scale.
        """
        features, measured = self.features, shown[..., 1:]
        half = features.half_range().to(measured)
        centre = ((torch.tensor(features.low) + torch.tensor(features.high)) / 2).to(measured)
        value = measured * half + centre
        if self.norm == "linf":
            reach = self.budget * half
            low, high = value - reach, value + reach
        else:
            floor = torch.tensor(features.floors or (0.0,) * len(features.names)).to(measured) * (self.budget / 0.1)
            larger, smaller = value / max(1 - self.budget, 1e-3), value / (1 + self.budget)
            low = torch.minimum(value - floor, torch.minimum(larger, smaller))
            high = torch.maximum(value + floor, torch.maximum(larger, smaller))
        if features.fixed:
            forged = features.forgeable().to(value) > 0
            low, high = torch.where(forged, low, value), torch.where(forged, high, value)
        noise = torch.tensor([self.noise if name in ALONG else 0.0 for name in features.names]).to(value)
        noise = noise * (torch.arange(value.shape[-2]) > 0).to(value).unsqueeze(-1)
        low, high = low - noise, high + noise
        end = half * (1 - 1e-5)
        low = torch.where(low - centre <= -end, -torch.inf, low)
        high = torch.where(high - centre >= end, torch.inf, high)
        return Boxes(shown[..., 0] > 0, low, high)

    def normalised(self, values: Tensor) -> Tensor:
        """Physical values of the measured features [..., F - 1] on the scale of observations, clipped to [-1, 1]."""
        low, high = (torch.tensor(bound).to(values) for bound in (self.features.low, self.features.high))
        return ((values - low) / (high - low) * 2 - 1).clamp(-1, 1)
