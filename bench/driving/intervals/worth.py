"""The scores of a driver by rules in one compiled call, forward and backward; torch computes whatever it is not made for."""

from __future__ import annotations

from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.autograd.function import once_differentiable

from cavbench.driving.features import Features
from cavbench.driving.intervals import judge_kernels, worth_kernels
from cavbench.driving.intervals.boxes import Boxes, flat
from cavbench.driving.intervals.ego import predicted
from cavbench.driving.intervals.margins import Judge
from cavbench.driving.intervals.mask import compilable, facts


class Worth:
    """The same as `cavbench.driving.victims.planner.IntervalPlanner` in torch.

    Its answers are those of torch to the last bit, its gradients to rounding.

    Args:
        judge: the judge, with the ego's kinematics.
        features: names and ranges of the measured features.
        values: the constants of the driver.
    """

    marked: ClassVar[tuple[str, ...]] = ("judge", "features", "values", "facts", "order")
    """What the watch compares (`cavbench.isolation.watch.marks`)."""

    def __init__(self, judge: Judge, features: Features, values: worth_kernels.Worths) -> None:
        self.judge, self.features, self.values = judge, features, values

    def fits(self, observation: Tensor, state: TensorDictBase) -> bool:
        """Whether it can answer about observations [..., V, F] with the state of as many episodes."""
        return self.judge.reckoning.kinematics.way is None and compilable(observation, state)

    def __call__(self, boxes: Boxes, ego: Tensor) -> tuple[Tensor, Tensor]:
        """The scores [..., A], differentiable once in the boxes, and whether any action is safe, bool [...].

        Args:
            boxes: of observations that it `fits`, [..., V, F - 1].
            ego: the reckoned ego, a state [..., 7] as of `DeadReckoning.after`.
        """
        if boxes.low.requires_grad and torch.is_grad_enabled():
            scores, safe = _Worth.apply(boxes.low, boxes.high, boxes.present, ego, self)
            return scores, safe
        return _worth(boxes, ego, self)[0]

    @cached_property
    def facts(self) -> judge_kernels.Facts:
        """The world and the constants as the compiled loops take them."""
        return facts(self.judge, self.features)

    @cached_property
    def order(self) -> np.ndarray[Any, np.dtype[np.int64]]:
        """The place of each action of the world in `ego.ORDER`."""
        return np.array(self.judge.reckoning.order, np.int64)


def _worth(boxes: Boxes, ego: Tensor, of: Worth) -> tuple[tuple[Tensor, Tensor], list[Any]]:
    """The scores, and whether any action is safe; and what the gradient needs besides."""
    rooms, leading = of.judge.rooms, boxes.low.shape[:-2]
    given = flat(boxes.present, 1), *predicted(ego), flat(boxes.low, 2), flat(boxes.high, 2)
    tables = rooms.following.tables, rooms.following.side, rooms.asked, rooms.rules
    scores, safe, *kept = worth_kernels.worth(*given, *tables, of.facts, rooms.top, of.values, of.order)
    answers = torch.from_numpy(scores).view(*leading, scores.shape[1]), torch.from_numpy(safe).view(leading)
    return answers, kept


class _Worth(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, low: Tensor, high: Tensor, present: Tensor, ego: Tensor, of: Worth) -> tuple[Tensor, Tensor]:
        answers, ctx.kept = _worth(Boxes(present, low, high), ego, of)
        ctx.of, ctx.shape = of, low.shape
        ctx.mark_non_differentiable(answers[1])
        return answers

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_scores: Tensor, _: Any) -> tuple[Tensor | None, ...]:
        of, rooms = ctx.of, ctx.of.judge.rooms
        tables = rooms.following.tables, rooms.following.side, rooms.rules
        given = *ctx.kept, *tables, of.facts, of.values, of.order
        by_low, by_high = worth_kernels.worth_backward(flat(by_scores, 1), *given)
        return torch.from_numpy(by_low).view(ctx.shape), torch.from_numpy(by_high).view(ctx.shape), None, None, None
