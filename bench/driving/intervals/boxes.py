"""The interval of true values behind each shown value, for an assumed perturbation set."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from cavbench.driving.features import Features
from cavbench.driving.intervals import box_kernels
from cavbench.driving.intervals.kernels import Floats
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

    def boxes(self, shown: Tensor, tracks: Tensor | None = None) -> Boxes:
        """The true values from which the set leads to the shown ones: the inverse of `ObservationThreat.radius`.

        With the norm `relative` a shown z stands for true values in [min(z - f, z / (1 +- b)), max(z + f, z / (1 -+ b))], where
        b is the budget and f the floor, and + or - is chosen by the sign of z. Boxes of other cars are wider by the noise at
        both ends; the ego's own row is measured without any.

        Args:
            shown: the observation that the policy received, [..., V, F], on the normalised scale.
            tracks: what `tracks.predicted` gave for the same episodes; each other car's box is intersected with the
                hull of all those that it may belong to. The hull makes it sound where a measurement fits several cars. A box
                that fits none stays, and so does a feature whose intersection is empty.
        """
        if shown.requires_grad and torch.is_grad_enabled():
            low, high = _Boxes.apply(shown, self, tracks)
        else:
            low, high = (shaped(one, shown.shape[:-2], shown) for one in self.bounds(*_flat(shown, tracks))[:2])
        return Boxes(shown[..., 0] > 0, low, high)

    def bounds(self, shown: Floats, tracks: Floats | None, *, sloped: bool = False) -> tuple[Floats, Floats, Floats]:
        """`boxes` on arrays: the bounds, [N, V, F - 1] each, and how both change with the shown values, if wanted.

        Args:
            shown: observations [N, V, F].
            tracks: as in `boxes`, [N, V - 1, 2 F - 1].
            sloped: whether the slopes are wanted, [2, N, V, F - 1]; otherwise there are none, [2, 0, V, F - 1].
        """
        count, rows, size = shown.shape
        low, high = np.empty((2, count, rows, size - 1), np.float32)
        slopes = np.empty((2, count if sloped else 0, rows, size - 1), np.float32)
        box_kernels.boxes(shown, self._set, low, high, slopes)
        if tracks is not None:
            box_kernels.narrow(shown, tracks, low, high, slopes)
        return low, high, slopes

    @cached_property
    def _set(self) -> box_kernels.Set:
        """The set as the compiled loop takes it."""
        features, half = self.features, self.features.half_range()
        centre, forged = (torch.tensor(features.low) + torch.tensor(features.high)) / 2, features.forgeable() > 0
        relative, count = self.norm == "relative", len(features.names)
        floor = torch.tensor(features.floors or (0.0,) * count) * (self.budget / 0.1)
        reach = torch.where(forged, floor if relative else self.budget * half, 0.0)
        divisors = (max(1 - self.budget, 1e-3), 1 + self.budget) if relative else (1.0, 1.0)
        larger, smaller = (torch.where(forged, torch.full((count,), one), 1.0) for one in divisors)
        noise = torch.tensor([self.noise if name in ALONG else 0.0 for name in features.names])
        return box_kernels.Set(*(one.float().numpy() for one in (half, centre, reach, larger, smaller, noise)))

    def normalised(self, values: Tensor) -> Tensor:
        """Physical values of the measured features [..., F - 1] on the scale of observations, clipped to [-1, 1]."""
        return self.features.normalised(values).clamp(-1, 1)


def _flat(shown: Tensor, tracks: Tensor | None) -> tuple[Floats, Floats | None]:
    return flat(shown, 2), None if tracks is None else flat(tracks, 2)


class _Boxes(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, shown: Tensor, of: Assumed, tracks: Tensor | None) -> tuple[Tensor, Tensor]:
        low, high, slopes = of.bounds(*_flat(shown, tracks), sloped=True)
        ctx.kept = slopes, shown.shape, shown.new_empty(0)
        return shaped(low, shown.shape[:-2], shown), shaped(high, shown.shape[:-2], shown)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_low: Tensor, by_high: Tensor) -> tuple[Tensor, None, None]:
        slopes, shape, like = ctx.kept
        by_shown = np.empty((*slopes.shape[1:-1], shape[-1]), np.float32)
        box_kernels.boxes_backward(slopes, flat(by_low, 2), flat(by_high, 2), by_shown)
        return shaped(by_shown, shape[:-2], like), None, None


def flat(tensor: Tensor, kept: int) -> NDArray[Any]:
    """The values [N, ...] of a tensor, with all but the last `kept` dimensions in one; numbers as float32."""
    values = tensor.detach()
    # Conversions cost as much as a short loop, even where there is nothing to convert.
    if not values.is_cpu or values.dtype not in (torch.float32, torch.bool):
        values = values.cpu() if values.dtype == torch.bool else values.cpu().float()
    leading = tensor.ndim - kept
    if leading != 1:
        values = values.reshape(tensor.shape[:leading].numel(), *tensor.shape[leading:])
    found: NDArray[Any] = values.contiguous().numpy()
    return found


def shaped(values: NDArray[Any], leading: torch.Size, like: Tensor) -> Tensor:
    """A tensor [*leading, ...] of values [N, ...]."""
    made = torch.from_numpy(values)
    if len(leading) != 1:
        made = made.view(*leading, *values.shape[1:])
    return made if like.is_cpu and like.dtype == made.dtype else made.to(like)
