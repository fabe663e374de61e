"""Smoothing over time: the victim receives the mean or the median of the last observations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from annotated_types import Ge
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from cavbench.driving import DrivingDefense, DrivingFacts, DrivingVictim, Policy, PolicyWrapper, State

Reduction = Literal["mean", "median"]


class _FrameStack(PolicyWrapper):
    """A policy on a stack of the last `frames` observations; its state is the stack and the inner policy's state."""

    def __init__(self, inner: Policy, frames: int, reduce: Reduction) -> None:
        super().__init__(inner)
        self.frames, self.reduce = frames, reduce

    def initial(self, episodes: Tensor) -> State:
        return TensorDict(_own(self.policy.initial(episodes)), batch_size=episodes.shape)

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        assert state is not None
        return self.policy.scores(self._smoothed(observation, state), state.get("inner", None))

    def value(self, observation: Tensor, action: Tensor, state: State = None) -> Tensor:
        assert state is not None
        return self.policy.value(self._smoothed(observation, state), action, state.get("inner", None))

    def advance(self, observation: Tensor, action: Tensor, state: State) -> State:
        assert state is not None
        inner = self.policy.advance(self._smoothed(observation, state), action, state.get("inner", None))
        stack = self._stack(observation, state)[..., 1:, :, :]
        return TensorDict({"stack": stack, **_own(inner)}, batch_size=state.batch_size)

    def _stack(self, observation: Tensor, state: TensorDictBase) -> Tensor:
        """[..., frames, V, F] the last observations, the newest last; before the first step, repetitions of the first one."""
        newest = observation.unsqueeze(-3)
        if state.get("stack", None) is None:
            return newest.expand(*newest.shape[:-3], self.frames, *newest.shape[-2:])
        return torch.cat((state["stack"], newest), -3)

    def _smoothed(self, observation: Tensor, state: TensorDictBase) -> Tensor:
        """[..., V, F] the current presence; each measured feature reduced over the frames in which its row is present."""
        if state.get("stack", None) is None:
            return observation
        stack, present = self._stack(observation, state), observation[..., :1] > 0
        measured = torch.where(stack[..., :1] > 0, stack[..., 1:], torch.nan)
        reduced = measured.nanmean(-3) if self.reduce == "mean" else _median(measured)
        return torch.cat((observation[..., :1], torch.where(present, reduced, 0.0)), -1)


def _median(measured: Tensor) -> Tensor:
    """The median [..., V, F - 1] over frames, ignoring NaN; for an even number, the mean of the two middle values."""
    return (measured.nanmedian(-3).values - (-measured).nanmedian(-3).values) / 2


def _own(state: State) -> dict[str, TensorDictBase]:
    return {} if state is None else {"inner": state}


@dataclass(frozen=True, kw_only=True)
class FrameStack(DrivingDefense):
    """The victim receives the mean or the median of the last k observations.

    This removes perturbations that change from frame to frame, but not constant ones. The result is delayed: by (k - 1) / 2
    frames with the mean. Rows are ordered by distance, so when two cars change order their rows are mixed for k - 1 frames.

    Args:
        frames: k, number of observations; before the k-th step, earlier ones are copies of the first.
        reduce: `mean` or `median` of each feature, over the frames in which the row is present.
    """

    frames: Annotated[int, Ge(2)] = 4
    reduce: Reduction = "mean"

    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        return _FrameStack(victim.load(seed, facts), self.frames, self.reduce).eval()
