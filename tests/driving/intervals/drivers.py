"""Drivers that want to crash, and roads for them: what tests of intervals, shield, tracker and planner share."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from cavbench.driving import ObservationThreat, Policy
from cavbench.driving.rollout import rollout
from cavbench.envs.highway.batched import BatchedHighway
from cavbench.envs.highway.world import HighwayWorld
from cavbench.scenarios import SeedBlock

WORLD = HighwayWorld()
FACTS = WORLD.facts
FAST = FACTS.actions.index("FASTER")
SEEDS = range(SeedBlock.TRAIN, SeedBlock.TRAIN + 6)


class Fastest(Policy):
    """Always FASTER, with a gradient, so that only the filter keeps it from crashing."""

    action_type = "discrete"

    def forward(self, observation: Tensor) -> Tensor:
        wanted = torch.eye(len(FACTS.actions))[FAST]
        return wanted + 1e-3 * observation.flatten(-2).sum(-1, keepdim=True)


class Pushing(Policy):
    """Always the same controls, with a gradient, so that only the filter keeps it from crashing."""

    action_type = "continuous"

    def __init__(self, acceleration: float, steering: float) -> None:
        super().__init__()
        self.controls = torch.tensor([acceleration, steering])

    def forward(self, observation: Tensor) -> Tensor:
        return self.controls + 1e-3 * observation.flatten(-2).sum(-1, keepdim=True)


def roads(world: HighwayWorld, episodes: int = len(SEEDS), **values: Any) -> BatchedHighway:
    cell = world.axes.cell(**{"lanes": 3, "density": 1.0, "weather": "clear"} | values)
    return world.make([cell] * episodes)  # type: ignore[return-value]


def driven(world: HighwayWorld, policy: Policy, attack: Any, **values: Any) -> dict[str, Any]:
    threat = ObservationThreat(budget=0.1 if attack else 0.0)
    cell = world.axes.cell(**{"lanes": 3, "density": 1.0, "weather": "clear"} | values)
    env = world.make([cell] * len(SEEDS), action_type=policy.action_type)
    return rollout(env, policy, attack, threat, list(SEEDS), facts=world.facts, attack_seed=0)
