"""The filter of discrete actions in compiled calls, forward and backward; torch computes whatever they are not made for."""

from __future__ import annotations

from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.autograd.function import once_differentiable

from cavbench.driving.features import Features
from cavbench.driving.fused.network import Fused
from cavbench.driving.intervals import box_kernels, filter_kernels, judge_kernels, margins
from cavbench.driving.intervals.boxes import Assumed, Boxes, flat
from cavbench.driving.intervals.ego import predicted
from cavbench.driving.intervals.kernels import Flags, Floats
from cavbench.driving.intervals.repeats import answered


class Weighed(NamedTuple):
    """What a filter makes of an observation.

    Args:
        seen: the observation with the reckoned ego, [..., V, F].
        margins: those of FASTER, IDLE, SLOWER and of both lane changes, ways out included, in m, [..., 5].
        hard: 1 for the actions that are allowed and 0 for the others, in the same order, [..., 5].
        safe: bool [...], whether any action is.
    """

    seen: Tensor
    margins: Tensor
    hard: Tensor
    safe: Tensor


def compilable(observation: Tensor, state: TensorDictBase) -> bool:
    """Whether compiled loops can answer about observations [..., V, F] with the state of as many episodes."""
    if observation.dtype != torch.float32 or observation.device.type != "cpu" or torch.compiler.is_compiling():
        return False
    if observation.shape[-2] < 2 or torch._C._are_functorch_transforms_active():
        return False
    return state.batch_size == observation.shape[:-2]


def facts(judge: margins.Judge, features: Features) -> judge_kernels.Facts:
    """The world and the constants of a judge as the compiled loops take them."""
    least, most = np.array(features.low, np.float32), np.array(features.high, np.float32)
    single = {
        "kept": judge.reckoning.kept,
        "settled_m": margins.SETTLED_M,
        "settled_rad": margins.SETTLED_RAD,
        "clearing_m": margins.CLEARING_M,
    }
    numbers = {name: np.float32(value) for name, value in single.items()}
    return judge_kernels.Facts(judge.reckoning.car, margins.PARTS, low=least, span=most - least, **numbers)


class Mask:
    """The same as `ego.DeadReckoning.now`, `policy.corrected`, `margins.Judge` and the mask of a filter.

    Its answers are those of torch to the last bit, its gradients to rounding.

    Args:
        judge: the judge, with the ego's kinematics.
        assumed: the assumed perturbation set, with the features.
        band: margin of FASTER in m from which on slower actions are masked.
        softness: width in m over which the gradient of the mask is spread.
    """

    marked: ClassVar[tuple[str, ...]] = ("judge", "assumed", "band", "softness", "facts", "order")
    """What the watch compares (`cavbench.isolation.watch.marks`)."""

    def __init__(self, judge: margins.Judge, assumed: Assumed, band: float, softness: float) -> None:
        self.judge, self.assumed, self.band, self.softness = judge, assumed, band, softness

    def fits(self, observation: Tensor, state: TensorDictBase) -> bool:
        """Whether it can answer about observations [..., V, F] with the state of as many episodes."""
        return self.judge.reckoning.kinematics.way is None and compilable(observation, state)

    def __call__(self, observation: Tensor, boxes: Boxes, ego: Tensor) -> Weighed:
        """What the filter makes of observations that it `fits`, differentiable once in them and in the boxes.

        Args:
            observation: as shown, [..., V, F].
            boxes: their boxes, [..., V, F - 1].
            ego: the reckoned ego, a state [..., 7] as of `DeadReckoning.after`.
        """
        if torch.is_grad_enabled() and (observation.requires_grad or boxes.low.requires_grad):
            return Weighed(*_Weigh.apply(observation, boxes.low, boxes.high, boxes.present, ego, self))
        return Weighed(*_weigh(observation, boxes, ego, self)[0])

    def lowered(self, values: Tensor, weighed: Weighed) -> Tensor:
        """The scores [..., A], lowered for the actions that are not allowed; `values` are those of the policy behind."""
        if values.dtype != torch.float32 or values.device.type != "cpu":
            soft = weighed.margins.div(self.softness).sigmoid()
            allowed = (weighed.hard + soft - soft.detach())[..., self.judge.reckoning.order]
            return values - ((values.amax(-1, keepdim=True) - values.amin(-1, keepdim=True)).detach() + 1) * (
                1 - allowed
            )
        if torch.is_grad_enabled() and (values.requires_grad or weighed.margins.requires_grad):
            scores: Tensor = _Lower.apply(values, weighed.margins, weighed.hard, self)
            return scores
        return self.lower(values, weighed.margins, weighed.hard)[0]

    def scores(
        self, observation: Tensor, assumed: Assumed, tracks: Tensor | None, ego: Tensor, network: Fused
    ) -> Tensor:
        """The scores [..., A] of observations that it and a network behind it `fit`: boxes, filter and network in one node.

        The same as `__call__` with their boxes, the network, and `lowered`, to the last bit; so is the gradient.

        Args:
            observation, ego: as in `__call__`.
            assumed, tracks: what the boxes follow from (`Assumed.boxes`).
            network: the network of the policy behind.
        """
        if torch.is_grad_enabled() and observation.requires_grad:
            scores: Tensor = _Score.apply(observation, assumed, tracks, ego, self, network)
            return scores

        def answer(shown: Tensor, moved: Tensor | None, own: Tensor) -> Tensor:
            return _score(shown, assumed, moved, own, self, network, sloped=False)[0]

        return answered(answer, observation, tracks, ego)

    def weigh(self, shown: Floats, present: Flags, ego: Tensor, low: Floats, high: Floats) -> tuple[Any, ...]:
        """The fields of `Weighed` for N observations and their boxes, and what `weigh_backward` needs, on arrays."""
        rooms, given = self.judge.rooms, (shown, present, *predicted(ego), low, high)
        return filter_kernels.weigh(*given, *self.tables, rooms.asked, rooms.rules, self.facts, np.float32(self.band))

    def weigh_backward(self, by_seen: Floats, by_margins: Floats, kept: judge_kernels.Kept) -> tuple[Floats, ...]:
        """The gradients in the observations [N, V, F] and in both bounds of their boxes, [N, V, F - 1] each."""
        given = by_seen, by_margins, *self.tables, self.judge.rooms.rules, self.facts, kept
        found: tuple[Floats, ...] = filter_kernels.weigh_backward(*given)
        return found

    def lower(self, values: Tensor, margins: Tensor, hard: Tensor) -> tuple[Tensor, tuple[Floats, Floats]]:
        """The lowered scores, and what `lower_backward` needs."""
        given, soft = flat(values, 1), flat(margins.detach().div(self.softness).sigmoid(), 1)
        out, spread = np.empty_like(given), np.empty(len(given), np.float32)
        filter_kernels.masked(given, flat(hard, 1), soft, self.order, out, spread)
        return torch.from_numpy(out).view(values.shape), (soft, spread)

    def lower_backward(self, by_out: Floats, soft: Floats, spread: Floats) -> Floats:
        """The gradient in the margins, [N, 5]."""
        by_x = np.empty_like(soft)
        filter_kernels.masked_backward(by_out, soft, spread, self.order, np.float32(self.softness), by_x)
        return by_x

    @cached_property
    def facts(self) -> judge_kernels.Facts:
        """The world and the constants as the compiled loops take them."""
        return facts(self.judge, self.assumed.features)

    @cached_property
    def order(self) -> np.ndarray[Any, np.dtype[np.int64]]:
        """The place of each action of the world in `ego.ORDER`."""
        return np.array(self.judge.reckoning.order, np.int64)

    @property
    def tables(self) -> tuple[Any, int]:
        """The following distances, and the number of speeds in one of them."""
        following = self.judge.rooms.following
        return following.tables, following.side


def _weigh(observation: Tensor, boxes: Boxes, ego: Tensor, of: Mask) -> tuple[tuple[Tensor, ...], judge_kernels.Kept]:
    """The fields of `Weighed`, and what the gradient needs besides."""
    leading = observation.shape[:-2]
    given = flat(observation, 2), flat(boxes.present, 1), ego, flat(boxes.low, 2), flat(boxes.high, 2)
    *found, kept = of.weigh(*given)
    seen, margin, hard, safe = map(torch.from_numpy, found)
    if len(leading) != 1:
        seen, margin, hard, safe = (one.view(*leading, *one.shape[1:]) for one in (seen, margin, hard, safe))
    return (seen, margin, hard, safe), kept


def _score(
    observation: Tensor, assumed: Assumed, tracks: Tensor | None, ego: Tensor, of: Mask, network: Fused, *, sloped: bool
) -> tuple[Tensor, Any]:
    """The scores, and what the gradient needs."""
    shown = flat(observation, 2)
    low, high, slopes = assumed.bounds(shown, None if tracks is None else flat(tracks, 2), sloped=sloped)
    seen, margins, hard, _, kept = of.weigh(shown, shown[..., 0] > 0, ego, low, high)
    passed = torch.from_numpy(seen)
    values, behind = network.forward(passed, keeps=sloped and network.keeps(passed))
    scores, lowered = of.lower(values, torch.from_numpy(margins), torch.from_numpy(hard))
    return scores.view(*observation.shape[:-2], network.outputs), (slopes, kept, behind, lowered)


class _Weigh(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, observation: Tensor, low: Tensor, high: Tensor, present: Tensor, ego: Tensor, of: Mask
    ) -> tuple[Tensor, ...]:
        answers, ctx.kept = _weigh(observation, Boxes(present, low, high), ego, of)
        ctx.of, ctx.shape = of, observation.shape
        ctx.mark_non_differentiable(*answers[2:])
        return answers

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_seen: Tensor, by_margins: Tensor, *_: Any) -> tuple[Tensor | None, ...]:
        found = ctx.of.weigh_backward(flat(by_seen, 2), flat(by_margins, 1), ctx.kept)
        by_shown, by_low, by_high = map(torch.from_numpy, found)
        box = *ctx.shape[:-1], ctx.shape[-1] - 1
        return by_shown.view(ctx.shape), by_low.view(box), by_high.view(box), None, None, None


class _Lower(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, margin: Tensor, hard: Tensor, of: Mask) -> Tensor:
        scores, ctx.kept = of.lower(values, margin, hard)
        ctx.of, ctx.shape = of, margin.shape
        return scores

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_out: Tensor) -> tuple[Tensor, Tensor, None, None]:
        by_x = ctx.of.lower_backward(flat(by_out, 1), *ctx.kept)
        return by_out, torch.from_numpy(by_x).view(ctx.shape), None, None


class _Score(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        observation: Tensor,
        assumed: Assumed,
        tracks: Tensor | None,
        ego: Tensor,
        of: Mask,
        network: Fused,
    ) -> Tensor:
        scores, ctx.kept = _score(observation, assumed, tracks, ego, of, network, sloped=True)
        ctx.of, ctx.network, ctx.shape = of, network, observation.shape
        return scores

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_scores: Tensor) -> tuple[Tensor | None, ...]:
        slopes, kept, behind, lowered = ctx.kept
        by_seen = ctx.network.backward(behind, by_scores).reshape(slopes.shape[1], *ctx.shape[-2:])
        by_margins = ctx.of.lower_backward(flat(by_scores, 1), *lowered)
        by_shown, by_low, by_high = ctx.of.weigh_backward(by_seen, by_margins, kept)
        by_boxes = np.empty_like(by_shown)
        box_kernels.boxes_backward(slopes, by_low, by_high, by_boxes)
        by_shown += by_boxes
        return torch.from_numpy(by_shown).view(ctx.shape), None, None, None, None, None
