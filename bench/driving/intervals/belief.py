"""Points of what the true state may be in one compiled call; torch computes whatever it is not made for."""

from __future__ import annotations

from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.autograd.function import once_differentiable

from cavbench.driving.intervals import belief_kernels
from cavbench.driving.intervals.boxes import Assumed, Boxes, flat
from cavbench.driving.intervals.ego import DeadReckoning, predicted
from cavbench.driving.intervals.mask import compilable


class Belief:
    """Points of the belief with the reckoned ego: the middle of the boxes, and corners.

    The points are those of torch to the last bit, their gradients to rounding.

    Args:
        reckoning: the ego's kinematics.
        assumed: the assumed perturbation set, with the features.
    """

    marked: ClassVar[tuple[str, ...]] = ("reckoning", "assumed", "scale")
    """What the watch compares (`cavbench.isolation.watch.marks`)."""

    def __init__(self, reckoning: DeadReckoning, assumed: Assumed) -> None:
        self.reckoning, self.assumed = reckoning, assumed

    def fits(self, observation: Tensor, state: TensorDictBase) -> bool:
        """Whether it can answer about observations [..., V, F] with the state of as many episodes."""
        return compilable(observation, state)

    def __call__(self, observation: Tensor, boxes: Boxes, ego: Tensor, signs: Tensor) -> Tensor:
        """The points [3 + K, ..., V, F] of observations that it `fits`, differentiable once in them and in the boxes.

        The first ones are the middle, the corner where every car is nearer and closing faster, and the opposite one.

        Args:
            observation: as shown, [..., V, F].
            boxes: their boxes, [..., V, F - 1].
            ego: the reckoned ego, a state [..., 7] as of `DeadReckoning.after`.
            signs: further corners, -1 or 1, [K, V, F - 1].
        """
        points: Tensor = _Believe.apply(observation, boxes.low, boxes.high, boxes.present, ego, signs, self)
        return points

    @cached_property
    def scale(self) -> belief_kernels.Scale:
        """The scale of observations as the compiled loops take it."""
        features = self.assumed.features
        least, most = np.array(features.low, np.float32), np.array(features.high, np.float32)
        return belief_kernels.Scale(least, most - least)


class _Believe(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        observation: Tensor,
        low: Tensor,
        high: Tensor,
        present: Tensor,
        ego: Tensor,
        signs: Tensor,
        of: Belief,
    ) -> Tensor:
        shown, there, (egos, turned) = flat(observation, 2), flat(present, 1), predicted(ego)
        box, corners = (flat(low, 2), flat(high, 2)), flat(signs, 2)
        points = np.empty((3 + len(corners), *shown.shape), np.float32)
        motion, slopes = np.empty((len(shown), 3), np.float32), np.empty((len(shown), 4), np.float32)
        given = shown, there, egos, turned, *box, corners, of.reckoning.car, of.scale
        belief_kernels.believe(*given, points, motion, slopes)
        ctx.kept, ctx.shape = (there, turned, *box, corners, of.scale, motion, slopes), observation.shape
        return torch.from_numpy(points).view(len(points), *observation.shape)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_points: Tensor) -> tuple[Tensor | None, ...]:
        given = flat(by_points.flatten(1, -3), 3)
        shape, box = given.shape[1:], (*given.shape[1:-1], given.shape[-1] - 1)
        by_shown, by_low, by_high = np.zeros(shape, np.float32), *np.zeros((2, *box), np.float32)
        belief_kernels.believe_backward(given, *ctx.kept, by_shown, by_low, by_high)
        into = *ctx.shape[:-1], ctx.shape[-1] - 1
        low, high = (torch.from_numpy(one).view(into) for one in (by_low, by_high))
        return torch.from_numpy(by_shown).view(ctx.shape), low, high, None, None, None, None
