"""Gaussian noise on everything that a driver sees: no attack can change the distribution of its episodes by much."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cavbench.core.ranges import Positive
from cavbench.driving import DrivingDefense, DrivingFacts, DrivingVictim, Passed, Policy, PolicyWrapper, State
from cavbench.driving.draws import noise
from cavbench.errors import UserError


@dataclass(frozen=True, kw_only=True)
class PolicySmoothing(DrivingDefense):
    """Adds Gaussian noise to each observation (Kumar, Levine and Feizi 2022, arXiv 2106.11420, "Policy Smoothing").

    The noise is drawn anew in every frame, N(0, sigma^2) for each measured value, on the normalised scale; whether a row is
    present is not changed. What an attack changes in a whole episode has a bounded L2 norm, and the noise hides a part of it.
    So the score has a lower bound that holds for every attack (Theorem 1), also for those that see the noise of all frames
    before: `cavbench.statistics.certificate`. Attacks ask a random victim several times about each point (`Oracle.draws`).

    Args:
        sigma: standard deviation of the noise on the normalised scale, on which 2 is the range of a feature; above 0
            (default 0.01, which is 1 m along the highway).

    Raises:
        UserError: if the victim is blind, or has a state, which would see noise of its own.
    """

    sigma: Positive = 0.01

    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        if not victim.sees:
            raise UserError("defense 'smoothing' needs a victim that sees")
        policy = victim.load(seed, facts)
        if policy.initial(torch.zeros(1, dtype=torch.int64)) is not None:
            raise UserError("defense 'smoothing' needs a victim without a state: nothing behind it may have a memory")
        return Smoothed(policy, self.sigma).eval()


class Smoothed(PolicyWrapper):
    """A policy without a state that receives noise on top of each observation."""

    def __init__(self, policy: Policy, sigma: float) -> None:
        super().__init__(policy)
        self.noise = sigma

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        return self.policy.scores(self.noisy(observation))

    def value(self, observation: Tensor, action: Tensor, state: State = None) -> Tensor:
        return self.policy.value(self.noisy(observation), action)

    def passed(self, observation: Tensor, state: State = None) -> Passed:
        return Passed(self.noisy(observation))

    def noisy(self, observation: Tensor) -> Tensor:
        """The observation [..., V, F] with noise on the measured values of the rows that are present."""
        shift = torch.zeros_like(observation)
        shift[..., 1:] = noise(observation) * self.noise * (observation[..., :1] > 0)
        return observation + shift
