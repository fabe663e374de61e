"""Defences that do not defend: one hides the input, two have no gradient, two are random."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from cavbench.driving import DrivingDefense, DrivingFacts, DrivingVictim, Policy, PolicyWrapper, State


class _Deaf(PolicyWrapper):
    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        return self.policy.scores(torch.zeros_like(observation), state)


class _Stepped(PolicyWrapper):
    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        return self.policy.scores((20 * observation).round() / 20, state)


class _Detached(PolicyWrapper):
    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        return self.policy.scores(observation.detach(), state)


class _Dicing(PolicyWrapper):
    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        scores = self.policy.scores(observation, state)
        return scores + 0.5 * torch.randn_like(scores)


class _Hiding(PolicyWrapper):
    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        scores = self.policy.scores(observation, state)
        return scores + 0.5 * torch.from_numpy(np.random.default_rng().normal(size=tuple(scores.shape))).to(scores)


@dataclass(frozen=True, kw_only=True)
class Deaf(DrivingDefense):
    """Shows the victim an empty road."""

    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        return _Deaf(victim.load(seed, facts))


@dataclass(frozen=True, kw_only=True)
class Stepped(DrivingDefense):
    """Rounds the observation, so that the gradient is zero."""

    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        return _Stepped(victim.load(seed, facts))


@dataclass(frozen=True, kw_only=True)
class Detached(DrivingDefense):
    """Detaches the gradient."""

    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        return _Detached(victim.load(seed, facts))


@dataclass(frozen=True, kw_only=True)
class Dicing(DrivingDefense):
    """Adds noise to the scores."""

    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        return _Dicing(victim.load(seed, facts))


@dataclass(frozen=True, kw_only=True)
class Hiding(DrivingDefense):
    """Adds noise to the scores, from a generator of its own, so that the run does not see that it is random."""

    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        return _Hiding(victim.load(seed, facts))
