"""A short drive in which an attack or a victim may cheat."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from cavbench.core.contracts import Access
from cavbench.core.track import Columns
from cavbench.driving import DrivingAttack, ObservationThreat, Oracle, Policy
from cavbench.driving.rollout import rollout
from cavbench.scenarios import Cell
from tests.plugins.toy import ToyPolicy, ToyWorld

WORLD = ToyWorld(max_steps=90)
SEEDS = range(1_000_000, 1_000_008)
CELL = Cell(lanes=3, density=1.0, weather="clear")


@dataclass(frozen=True, kw_only=True)
class Does(DrivingAttack):
    """Does what it is given, and shows what that returns (nothing: the truth)."""

    access: ClassVar[Access] = "gradients"
    deed: Callable[[Tensor, Oracle], Any]

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        answer = self.deed(observation, oracle)
        return observation if answer is None else answer


class Victim(ToyPolicy):
    """A toy policy that several cheats derive from."""

    def __init__(self) -> None:
        super().__init__("discrete", 0)
        self.eval()


class Noisy(Victim):
    """A defence that draws noise for every decision."""

    def forward(self, observation: Tensor) -> Tensor:
        return super().forward(observation + 0.5 * torch.randn(observation.shape))


def drive(
    deed: Callable[[Tensor, Oracle], Any] | None = None, policy: Policy | None = None, entropy: int = 1, **threat: Any
) -> Columns:
    """The measurements of 8 episodes of 90 steps."""
    policy = policy or Victim()
    env = WORLD.make([CELL] * len(SEEDS), action_type=policy.action_type)
    return rollout(
        env,
        policy,
        Does(deed=deed) if deed else None,
        ObservationThreat(**({"norm": "linf", "budget": 0.1, "queries": 50} | threat)),
        SEEDS,
        facts=WORLD.facts,
        attack_seed=7,
        entropy=entropy,
    )


def inconsistent(policy: Policy, deed: Callable[[Tensor, Oracle], Any] | None = None) -> float:
    """The share of probes that a victim answered otherwise than it drives."""
    return float(np.nanmean(drive(deed, policy)["inconsistent"]))
