"""Linear bounds of what is not linear in a network: activations, and the largest of several values."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

Interval = tuple[Tensor, Tensor]
"""The lowest and the highest value, of the same shape."""


class Relaxation(NamedTuple):
    """Two lines around a function of one value: slope * x + offset is below it, and another above it. All are [N, ...]."""

    lower_slope: Tensor
    lower_offset: Tensor
    upper_slope: Tensor
    upper_offset: Tensor


def relu(low: Tensor, high: Tensor) -> Relaxation:
    """Lines around max(x, 0) for x in [low, high] (CROWN, Zhang et al. 2018, arXiv 1811.00866, Table 2; adaptive below).

    Above: the chord. Below: slope 1 if more than half of the interval is positive, otherwise slope 0.
    """
    below, above = low.clamp(max=0), high.clamp(min=0)
    chord = above / (above - below).clamp(min=torch.finfo(low.dtype).tiny)
    slope = torch.where(low >= 0, 1.0, torch.where(high <= 0, 0.0, chord))
    lower = (above > -below).to(low)
    return Relaxation(lower, torch.zeros_like(low), slope, -slope * below)


def tanh(low: Tensor, high: Tensor) -> Relaxation:
    """Lines around tanh(x) for x in [low, high]: the chord where it bounds the curve, otherwise a line with the smallest slope.

    The smallest slope of the curve on the interval is that at its end farthest from 0. A line with this slope through the left
    end stays below an S-shaped curve, and one through the right end above it.
    """
    at_low, at_high = low.tanh(), high.tanh()
    flattest = 1 - torch.maximum(at_low.square(), at_high.square())
    chord = (at_high - at_low) / (high - low).clamp(min=1e-12)
    chord = torch.where(high - low < 1e-6, flattest, chord)
    # Left of 0 the curve is convex, so the chord is above it; right of 0 it is concave, so the chord is below.
    upper = torch.where(high <= 0, chord, flattest)
    lower = torch.where(low >= 0, chord, flattest)
    return Relaxation(lower, at_low - lower * low, upper, at_high - upper * high)


class LargestOf(NamedTuple):
    """Linear bounds of max(0, x_1, ..., x_C): sum(lower * x) is below it, and sum(upper * x) + offset is above it.

    Args:
        lower, upper: [N, C, K].
        offset: [N, K].
    """

    lower: Tensor
    upper: Tensor
    offset: Tensor


def largest(low: Tensor, high: Tensor) -> LargestOf:
    """Bounds of max(0, x_1, ..., x_C) for x in [low, high], [N, C, K] each.

    Below: the x_c with the highest lower bound, or 0. Above: with m = max(0, low_1, ..., low_C), either the constant max(m,
    high), or m + sum_c s_c (x_c - low_c) with s_c = max(high_c - m, 0) / (high_c - low_c), whichever is lower in the middle of
    the box. Both hold: the function is convex, so it is enough that they are above it in the corners of the box.
    """
    best = low.amax(1, keepdim=True)
    chosen = torch.zeros_like(low).scatter_(1, low.argmax(1, keepdim=True), 1.0)
    lower = chosen * (high.gather(1, low.argmax(1, keepdim=True)) > -best).to(low)
    middle = best.clamp(min=0)
    over = (high - middle).clamp(min=0)
    slope = over / (high - low).clamp(min=torch.finfo(low.dtype).tiny)
    slope = torch.where(high > low, slope, (over > 0).to(low))
    total, top = over.sum(1), over.amax(1)
    planar = (total / 2 <= top).unsqueeze(1)
    upper = torch.where(planar, slope, 0.0)
    offset = middle.squeeze(1) + torch.where(planar.squeeze(1), -(slope * low).sum(1), top)
    return LargestOf(lower, upper, offset)
