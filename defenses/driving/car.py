"""Training on the largest Bellman error within the perturbation set."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor

from cavbench.core.contracts import Progress, Trained
from cavbench.core.ranges import Positive, Share
from cavbench.defenses.driving.robust_loss import Own, RobustLoss, Worst
from cavbench.driving import DrivingVictim, DrivingWorld, Policy
from cavbench.errors import UserError


@dataclass(frozen=True, kw_only=True)
class ConsistentAdversarialRobustness(RobustLoss):
    """Trains true values of the taken actions throughout the perturbation set (CAR-DQN, Li et al. 2024, arXiv 2402.02165).

    The victim's own loss of each transition is taken at the point of the set where it is largest, and the transitions are
    weighted by the softmax of these losses: a smooth form of the largest Bellman error of all states (section 5, the soft
    objective). Discrete actions only.

    Args:
        weight: weight of this loss, from 0 (the victim's own loss only: the control) to 1 (the paper: this loss only).
        temperature: the paper's lambda, as a share of the mean loss of the batch; the higher, the more alike the weights.
    """

    name: ClassVar[str] = "car"

    weight: Share = 1.0
    temperature: Positive = 1.0

    def train(self, victim: DrivingVictim, world: DrivingWorld, *, seed: int, progress: Progress) -> Trained[Policy]:
        if victim.action_type != "discrete":
            raise UserError(f"car needs a victim with discrete actions, those of this one are {victim.action_type}")
        return super().train(victim, world, seed=seed, progress=progress)

    def loss(self, policy: Policy, sample: TensorDictBase, own: Own, worst: Worst) -> Tensor:
        def error(observation: Tensor) -> Tensor:
            return own(sample.copy().set("observation", observation))

        errors = error(worst(error))
        with torch.no_grad():
            weights = torch.softmax(errors / (self.temperature * errors.mean()).clamp(min=1e-12), 0)
        robust = (weights * errors).sum()
        return robust if self.weight == 1 else (1 - self.weight) * own(sample).mean() + self.weight * robust
