"""What tests of attacks with a network of their own share: short recipes, and a director with fixed values."""

from __future__ import annotations

import torch
from torch import Tensor

from cavbench.attacks.driving.paad import PAAD
from cavbench.attacks.driving.sarsa import RobustSarsa
from cavbench.attacks.driving.two_stage import TwoStage
from cavbench.core.contracts import Trained
from cavbench.defenses.none import NoDefense
from cavbench.driving import DrivingAttack, DrivingWorld, Policy
from cavbench.driving.victims.dqn import DQN

SHORT = {"decisions": 8, "hidden": 8}
LEARNED = [TwoStage(**SHORT), PAAD(**SHORT, training_steps=1), RobustSarsa(decisions=48, hidden=8, updates=1)]
NAMES = [type(attack).__name__ for attack in LEARNED]


def silent(share: float, text: str) -> None:
    """A progress callback that does nothing."""


class Preferring(Policy):
    """A director with the same values in every state."""

    action_type = "discrete"

    def __init__(self, *values: float) -> None:
        super().__init__()
        self.values = torch.tensor(values)

    def forward(self, observation: Tensor) -> Tensor:
        return self.values.expand(*observation.shape[:-2], -1)


def trained(attack: DrivingAttack, world: DrivingWorld, seed: int = 0) -> Trained[Policy]:
    """A short training against the shipped `dqn`."""
    return attack.train(DQN(), NoDefense(), world, seed=seed, progress=silent)
