"""Three defences that are none: one does not look, one has no gradient, one throws dice."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from bench.driving import DrivingDefense, DrivingVictim, Policy


class _Wrapped(Policy):
    def __init__(self, policy: Policy) -> None:
        super().__init__()
        self.policy, self.action_type = policy, policy.action_type


class _Deaf(_Wrapped):
    def scores(self, observation: Tensor) -> Tensor:
        return self.policy.scores(torch.zeros_like(observation))


class _Stepped(_Wrapped):
    def scores(self, observation: Tensor) -> Tensor:
        return self.policy.scores((20 * observation).round() / 20)


class _Detached(_Wrapped):
    def scores(self, observation: Tensor) -> Tensor:
        return self.policy.scores(observation.detach())


class _Dicing(_Wrapped):
    def scores(self, observation: Tensor) -> Tensor:
        scores = self.policy.scores(observation)
        return scores + 0.5 * torch.randn_like(scores)


@dataclass(frozen=True, kw_only=True)
class Deaf(DrivingDefense):
    """Shows the victim an empty road."""

    def load(self, victim: DrivingVictim, seed: int) -> Policy:
        return _Deaf(victim.load(seed))


@dataclass(frozen=True, kw_only=True)
class Stepped(DrivingDefense):
    """Rounds what the victim sees: its gradient is zero."""

    def load(self, victim: DrivingVictim, seed: int) -> Policy:
        return _Stepped(victim.load(seed))


@dataclass(frozen=True, kw_only=True)
class Detached(DrivingDefense):
    """Cuts the gradient off."""

    def load(self, victim: DrivingVictim, seed: int) -> Policy:
        return _Detached(victim.load(seed))


@dataclass(frozen=True, kw_only=True)
class Dicing(DrivingDefense):
    """Adds noise to the scores."""

    def load(self, victim: DrivingVictim, seed: int) -> Policy:
        return _Dicing(victim.load(seed))
