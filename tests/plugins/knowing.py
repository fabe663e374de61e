"""A dishonest defence: it knows the public scenarios by their first observation, and repeats what drove well there."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.driving import DrivingDefense, DrivingFacts, DrivingVictim, Policy, PolicyWrapper, State
from cavbench.envs.highway.world import HighwayWorld
from cavbench.scenarios import Cell

CELL = Cell(lanes=3, density=1.0, weather="clear")
SEEDS = torch.arange(1_000_000, 1_000_020)
ALIKE = 0.5
"""Largest mean distance of the other cars' places from those of a known scenario, as a share of the mean of all."""


class Knowing(PolicyWrapper):
    """Recognises a scenario when it begins, and then looks no more."""

    def __init__(self, policy: Policy) -> None:
        super().__init__(policy)
        self.first, self.actions = played(policy)
        self.typical = torch.cdist(self.first, self.first).mean()

    def initial(self, episodes: Tensor) -> State:
        zero = torch.zeros_like(episodes)
        return TensorDict({"which": zero - 2, "step": zero}, batch_size=episodes.shape)

    def which(self, observation: Tensor, state: State) -> Tensor:
        assert state is not None
        distance, nearest = torch.cdist(observation.flatten(-2), self.first).min(-1)
        seen = torch.where(distance < ALIKE * self.typical, nearest, -1)
        return torch.where(state["which"] == -2, seen, state["which"])

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        assert state is not None
        which, scores = self.which(observation, state), self.policy.scores(observation)
        known = torch.nn.functional.one_hot(self.actions[which.clamp(min=0), state["step"]], scores.shape[-1])
        return torch.where((which >= 0).unsqueeze(-1), known.to(scores), scores)

    def advance(self, observation: Tensor, action: Tensor, state: State) -> State:
        assert state is not None
        return TensorDict({"which": self.which(observation, state), "step": state["step"] + 1}, state.batch_size)


@cache
def played(policy: Policy) -> tuple[Tensor, Tensor]:
    """The first observations [S, V * F] of the public scenarios, and the actions [S, T] of an undisturbed drive."""
    world = HighwayWorld()
    env = world.make([CELL] * len(SEEDS))
    with torch.no_grad():
        td = env.reset(TensorDict({"seed": SEEDS}, batch_size=env.batch_size))
        first, actions = td["observation"].flatten(-2), []
        for _ in range(world.max_steps):
            actions.append(policy.decide(td["observation"]))
            td = env.step(td.set("action", actions[-1]))["next"]
    return first, torch.stack(actions, 1)


@dataclass(frozen=True, kw_only=True)
class Knows(DrivingDefense):
    """Drives the public scenarios by heart."""

    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        return Knowing(victim.load(seed, facts)).eval()
