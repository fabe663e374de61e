"""A driving policy on another device than the run."""

from __future__ import annotations

import torch
from torch import Tensor

from cavbench.core.device import CPU, move
from cavbench.driving.policy import Policy, PolicyWrapper, State, Suspicion


class Placed(PolicyWrapper):
    """A policy on another device: its input is copied there, and its answers, states and gradients come back to the processor.

    So the world, attacks, enforcement and measurements need not know where the victim computes.

    Args:
        policy: the (defended) victim.
        device: where it computes, for instance `cuda`.
    """

    def __init__(self, policy: Policy, device: str) -> None:
        super().__init__(policy)
        self.noise = policy.noise
        self._there = torch.device(device)
        move(policy, self._there)

    def initial(self, episodes: Tensor) -> State:
        return self._back(self.policy.initial(episodes.to(self._there)))

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        return self.policy.scores(observation.to(self._there), self._sent(state)).to(CPU)

    def advance(self, observation: Tensor, action: Tensor, state: State) -> State:
        there = self._there
        return self._back(self.policy.advance(observation.to(there), action.to(there), self._sent(state)))

    def assured(self, observation: Tensor, state: State) -> Tensor | None:
        found = self.policy.assured(observation.to(self._there), self._sent(state))
        return None if found is None else found.to(CPU)

    def suspicion(self, observation: Tensor, state: State) -> Suspicion | None:
        found = self.policy.suspicion(observation.to(self._there), self._sent(state))
        return None if found is None else Suspicion(found.level.to(CPU), found.alarm.to(CPU))

    def choose(self, scores: Tensor) -> Tensor:
        return self.policy.choose(scores.to(self._there)).to(CPU)

    def value(self, observation: Tensor, action: Tensor, state: State = None) -> Tensor:
        there = self._there
        return self.policy.value(observation.to(there), action.to(there), self._sent(state)).to(CPU)

    def _sent(self, state: State) -> State:
        return None if state is None else state.to(self._there)

    def _back(self, state: State) -> State:
        return None if state is None else state.to(CPU)


def placed(policy: Policy, device: str) -> Policy:
    """The policy on a device; itself on the processor."""
    return policy if device == CPU else Placed(policy, device)
