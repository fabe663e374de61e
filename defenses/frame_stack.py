"""Smoothing over time: the victim sees the mean or the median of the last frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from annotated_types import Ge
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from bench.driving import DrivingDefense, DrivingFacts, DrivingVictim, Policy, State

Reduction = Literal["mean", "median"]


class _FrameStack(Policy):
    """A policy behind a stack of the last `frames` observations; its state is the stack, and the policy's own state."""

    def __init__(self, inner: Policy, frames: int, reduce: Reduction) -> None:
        super().__init__()
        self.inner, self.frames, self.reduce = inner, frames, reduce
        self.action_type, self.driver, self.weights_sha256 = inner.action_type, inner.driver, inner.weights_sha256

    def initial(self, episodes: Tensor) -> State:
        return TensorDict(_own(self.inner.initial(episodes)), batch_size=episodes.shape)

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        assert state is not None
        return self.inner.scores(self._smoothed(observation, state), state.get("inner", None))

    def choose(self, scores: Tensor) -> Tensor:
        return self.inner.choose(scores)

    def value(self, observation: Tensor, action: Tensor, state: State = None) -> Tensor:
        assert state is not None
        return self.inner.value(self._smoothed(observation, state), action, state.get("inner", None))

    def advance(self, observation: Tensor, action: Tensor, state: State) -> State:
        assert state is not None
        inner = self.inner.advance(self._smoothed(observation, state), action, state.get("inner", None))
        stack = self._stack(observation, state)[..., 1:, :, :]
        return TensorDict({"stack": stack, **_own(inner)}, batch_size=state.batch_size)

    def _stack(self, observation: Tensor, state: TensorDictBase) -> Tensor:
        """[..., frames, V, F] what was shown, the newest last; before the first step, the first observation again and again."""
        newest = observation.unsqueeze(-3)
        if state.get("stack", None) is None:
            return newest.expand(*newest.shape[:-3], self.frames, *newest.shape[-2:])
        return torch.cat((state["stack"], newest), -3)

    def _smoothed(self, observation: Tensor, state: TensorDictBase) -> Tensor:
        """[..., V, F] presence as it is now; each measured feature reduced over the frames in which its row is present."""
        if state.get("stack", None) is None:
            return observation
        stack, present = self._stack(observation, state), observation[..., :1] > 0
        measured = torch.where(stack[..., :1] > 0, stack[..., 1:], torch.nan)
        reduced = measured.nanmean(-3) if self.reduce == "mean" else _median(measured)
        return torch.cat((observation[..., :1], torch.where(present, reduced, 0.0)), -1)


def _median(measured: Tensor) -> Tensor:
    """The median [..., V, F - 1] over frames, without NaN; of an even number, the mean of the two in the middle."""
    return (measured.nanmedian(-3).values - (-measured).nanmedian(-3).values) / 2


def _own(state: State) -> dict[str, TensorDictBase]:
    return {} if state is None else {"inner": state}


@dataclass(frozen=True, kw_only=True)
class FrameStack(DrivingDefense):
    """The victim sees the mean or the median of the last k observations.

    An attack that changes its mind from frame to frame is averaged out; one that holds its perturbation is not. What the victim
    sees is late: by (k - 1) / 2 frames under the mean. Rows of an observation are ordered by distance, so where two cars change
    places their rows are mixed for k - 1 frames.

    Args:
        frames: k, how many observations are reduced; in the beginning the first one stands for those before it.
        reduce: `mean` or `median`, feature by feature, over those of the frames in which the row is present.
    """

    frames: Annotated[int, Ge(2)] = 2
    reduce: Reduction = "mean"

    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        return _FrameStack(victim.load(seed, facts), self.frames, self.reduce).eval()
