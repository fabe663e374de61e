"""Beliefs about the true state in compiled calls, forward and backward; torch computes whatever they are not made for."""

from __future__ import annotations

from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.autograd.function import once_differentiable

from cavbench.driving.fused.network import Fused
from cavbench.driving.intervals import belief_kernels, box_kernels
from cavbench.driving.intervals.boxes import Assumed, Boxes, flat
from cavbench.driving.intervals.ego import DeadReckoning, predicted
from cavbench.driving.intervals.kernels import Flags, Floats
from cavbench.driving.intervals.mask import compilable
from cavbench.driving.intervals.repeats import answered


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

    def scores(
        self,
        observation: Tensor,
        assumed: Assumed,
        tracks: Tensor | None,
        ego: Tensor,
        signs: Tensor,
        pessimism: float,
        network: Fused,
    ) -> Tensor:
        """The scores [..., A] of observations that it and a network behind it `fit`: boxes, points and network in one node.

        The same as `__call__` with their boxes, the network, and the least of its answers, to the last bit; so is the gradient.

        Args:
            observation, ego, signs: as in `__call__`.
            assumed, tracks: what the boxes follow from (`Assumed.boxes`).
            pessimism: weight of the least answer; the rest is on the middle's.
            network: the network of the policy behind.
        """
        given = signs, pessimism, self, network
        if torch.is_grad_enabled() and observation.requires_grad:
            scores: Tensor = _Score.apply(observation, assumed, tracks, ego, *given)
            return scores

        def answer(shown: Tensor, moved: Tensor | None, own: Tensor) -> Tensor:
            return _score(shown, assumed, moved, own, *given, sloped=False)[0]

        return answered(answer, observation, tracks, ego)

    def believe(
        self, shown: Floats, there: Flags, ego: Tensor, low: Floats, high: Floats, signs: Tensor
    ) -> tuple[Floats, tuple[Any, ...]]:
        """The points [N, 3 + K, V, F] of N observations and their boxes, and what `believe_backward` needs."""
        (egos, turned), corners = predicted(ego), flat(signs, 2)
        points = np.empty((len(shown), 3 + len(corners), *shown.shape[1:]), np.float32)
        motion, slopes = np.empty((len(shown), 3), np.float32), np.empty((len(shown), 4), np.float32)
        given = shown, there, egos, turned, low, high, corners, self.reckoning.car, self.scale
        belief_kernels.believe(*given, points, motion, slopes)
        return points, (there, turned, low, high, corners, self.scale, motion, slopes)

    def believe_backward(self, by_points: Floats, kept: tuple[Any, ...]) -> tuple[Floats, Floats, Floats]:
        """The gradients in the observations [N, V, F] and in both bounds of their boxes, [N, V, F - 1] each."""
        count, _, rows, size = by_points.shape
        by_shown = np.zeros((count, rows, size), np.float32)
        by_low, by_high = np.zeros((2, count, rows, size - 1), np.float32)
        belief_kernels.believe_backward(by_points, *kept, by_shown, by_low, by_high)
        return by_shown, by_low, by_high

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
        boxes = flat(low, 2), flat(high, 2)
        points, ctx.kept = of.believe(flat(observation, 2), flat(present, 1), ego, *boxes, signs)
        ctx.of, ctx.shape = of, observation.shape
        return torch.from_numpy(points).transpose(0, 1).reshape(points.shape[1], *observation.shape)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_points: Tensor) -> tuple[Tensor | None, ...]:
        found = ctx.of.believe_backward(flat(by_points.flatten(1, -3).transpose(0, 1), 3), ctx.kept)
        by_shown, by_low, by_high = map(torch.from_numpy, found)
        box = *ctx.shape[:-1], ctx.shape[-1] - 1
        return by_shown.view(ctx.shape), by_low.view(box), by_high.view(box), None, None, None, None


def _score(
    observation: Tensor,
    assumed: Assumed,
    tracks: Tensor | None,
    ego: Tensor,
    signs: Tensor,
    pessimism: float,
    of: Belief,
    network: Fused,
    *,
    sloped: bool,
) -> tuple[Tensor, Any]:
    """The scores, and what the gradient needs."""
    shown, weight = flat(observation, 2), np.float32(pessimism)
    low, high, slopes = assumed.bounds(shown, None if tracks is None else flat(tracks, 2), sloped=sloped)
    points, kept = of.believe(shown, shown[..., 0] > 0, ego, low, high, signs)
    # Few of the answers count: those are computed again for the gradient.
    answers, behind = network.forward(torch.from_numpy(points), keeps=False)
    values, scores = answers.numpy(), np.empty((len(shown), network.outputs), np.float32)
    belief_kernels.least(values, weight, scores)
    shape = *observation.shape[:-2], network.outputs
    return torch.from_numpy(scores).view(shape), (slopes, kept, behind, values, weight)


class _Score(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        observation: Tensor,
        assumed: Assumed,
        tracks: Tensor | None,
        ego: Tensor,
        signs: Tensor,
        pessimism: float,
        of: Belief,
        network: Fused,
    ) -> Tensor:
        given = observation, assumed, tracks, ego, signs, pessimism, of, network
        scores, ctx.kept = _score(*given, sloped=True)
        ctx.of, ctx.network, ctx.shape = of, network, observation.shape
        return scores

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_scores: Tensor) -> tuple[Tensor | None, ...]:
        slopes, kept, behind, values, weight = ctx.kept
        by_values = np.empty_like(values)
        belief_kernels.least_backward(flat(by_scores, 1), values, weight, by_values)
        by_points = ctx.network.backward(behind, torch.from_numpy(by_values))
        by_shown, *by_bounds = ctx.of.believe_backward(by_points.reshape(*values.shape[:2], *ctx.shape[-2:]), kept)
        by_boxes = np.empty_like(by_shown)
        box_kernels.boxes_backward(slopes, *by_bounds, by_boxes)
        by_shown += by_boxes
        return torch.from_numpy(by_shown).view(ctx.shape), *[None] * 7
