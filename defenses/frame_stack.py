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
        seen = torch.zeros(len(episodes), dtype=torch.int64)
        return TensorDict({"seen": seen, **_own(self.inner.initial(episodes))}, batch_size=[len(episodes)])

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        assert state is not None
        return self.inner.scores(self._smoothed(observation, state), state.get("inner", None))

    def value(self, observation: Tensor, action: Tensor, state: State = None) -> Tensor:
        assert state is not None
        return self.inner.value(self._smoothed(observation, state), action, state.get("inner", None))

    def advance(self, observation: Tensor, action: Tensor, state: State) -> State:
        assert state is not None
        stack = self._stack(observation, state)
        inner = self.inner.advance(self._smoothed(observation, state), action, state.get("inner", None))
        return TensorDict({"seen": state["seen"] + 1, "stack": stack, **_own(inner)}, batch_size=state.batch_size)

    def _stack(self, observation: Tensor, state: TensorDictBase) -> Tensor:
        """[B, frames - 1, V, F] what is remembered after this observation, the newest last."""
        if state.get("stack", None) is None:
            return observation.unsqueeze(-3).expand(*observation.shape[:-2], self.frames - 1, *observation.shape[-2:])
        return torch.cat((state["stack"][..., 1:, :, :], observation.unsqueeze(-3)), -3)

    def _smoothed(self, observation: Tensor, state: TensorDictBase) -> Tensor:
        """The observation [..., V, F] after smoothing: presence is that of now."""
        if state.get("stack", None) is None:
            return observation
        stack = torch.cat((state["stack"], observation.unsqueeze(-3)), -3)
        measured = stack[..., 1:].mean(-3) if self.reduce == "mean" else stack[..., 1:].median(-3).values
        return torch.cat((observation[..., :1], measured * (observation[..., :1] > 0)), -1)


def _own(state: State) -> dict[str, TensorDictBase]:
    return {} if state is None else {"inner": state}


@dataclass(frozen=True, kw_only=True)
class FrameStack(DrivingDefense):
    """The victim sees the last k observations at once, reduced to their mean or median.

    An attack that changes its mind from frame to frame is averaged out; one that holds its perturbation is not. Rows of an
    observation are ordered by distance, so where two cars change places their rows are mixed for k frames.

    Args:
        frames: k, how many observations are stacked, at least 2.
        reduce: `mean` or `median` over them, feature by feature.
    """

    frames: Annotated[int, Ge(2)] = 4
    reduce: Reduction = "mean"

    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        return _FrameStack(victim.load(seed, facts), self.frames, self.reduce).eval()
