"""A victim with a memory, to check defences with."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.driving import ActionType, DrivingFacts, DrivingVictim, Policy, State
from cavbench.driving.checks.traffic import victim

SHARE = 0.5
"""Weight of the past in the running mean."""


class _Remembering(Policy):
    """Scores a running mean of the observations of an episode."""

    def __init__(self, policy: Policy) -> None:
        super().__init__()
        self.policy, self.action_type = policy, policy.action_type

    def initial(self, episodes: Tensor) -> State:
        return TensorDict({}, batch_size=episodes.shape)

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        return self.policy.scores(self._averaged(observation, state))

    def advance(self, observation: Tensor, action: Tensor, state: State) -> State:
        assert state is not None
        return TensorDict({"past": self._averaged(observation, state)}, batch_size=state.batch_size)

    @staticmethod
    def _averaged(observation: Tensor, state: State) -> Tensor:
        assert state is not None
        past = state.get("past", None)
        return observation if past is None else torch.lerp(observation, past, SHARE)


@dataclass(frozen=True, kw_only=True)
class Remembering(DrivingVictim):
    """A network with random weights and a memory.

    Args:
        actions: its action type.
    """

    actions: ActionType = "discrete"

    @property
    def action_type(self) -> ActionType:
        return self.actions

    def load(self, seed: int, facts: DrivingFacts) -> Policy:
        return _Remembering(victim(self.actions, facts)).requires_grad_(False).eval()
