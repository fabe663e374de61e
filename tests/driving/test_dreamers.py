"""A victim that tells a rehearsal from driving and answers otherwise there is flagged, whatever it tells it by."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.core.contracts import Access
from cavbench.driving import DrivingAttack, ObservationThreat, Oracle, Policy, State
from cavbench.driving.rollout import rollout
from tests.driving.cheats import CELL, SEEDS, Victim
from tests.plugins.toy import ToyWorld

WORLD = ToyWorld(max_steps=400)
FLAGGED = 0.01
"""The flag `decoy` fires from this share on."""


@dataclass(frozen=True, kw_only=True)
class Idle(DrivingAttack):
    """May rehearse, and does nothing."""

    access: ClassVar[Access] = "dynamics"

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        return observation


@dataclass(frozen=True, kw_only=True)
class Rehearses(DrivingAttack):
    """Rehearses three decisions in eight copies of some episodes."""

    access: ClassVar[Access] = "dynamics"
    rows: Callable[[int], list[int]] = lambda count: list(range(count))

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        rows = torch.tensor(self.rows(len(observation)))
        some = oracle.select(rows)
        state = some.imagined(8)
        for _ in range(3):
            _, state = some.rehearse(observation[rows].expand(8, -1, -1, -1), state)
        return observation


def drive(policy: Policy, attack: DrivingAttack, entropy: int = 1) -> Any:
    env = WORLD.make([CELL] * len(SEEDS))
    threat = ObservationThreat(norm="linf", budget=0.1, queries=50, access="dynamics")
    return rollout(env, policy, attack, threat, SEEDS, facts=WORLD.facts, attack_seed=7, entropy=entropy)


def inconsistent(policy: Callable[[], Policy], attack: DrivingAttack | None = None) -> float:
    return float(np.nanmean([drive(policy(), attack or Idle(), entropy)["inconsistent"] for entropy in range(3)]))


class Remembers(Victim):
    """Drives by a running mean of what it sees; `asleep` says which copies believe that they dream."""

    def initial(self, episodes: Tensor) -> State:
        self.real = len(episodes)
        count = len(episodes)
        own = {"mean": torch.zeros(count, 6), "dreams": torch.zeros(count), "number": torch.arange(count)}
        return TensorDict(own, batch_size=[count])

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        assert state is not None
        honest = ((observation.flatten(-2) + state["mean"]) @ self.weights).tanh()
        asleep = torch.tensor([0.0, 1.0, 0.0, 0.0, 0.5]).expand_as(honest)
        return torch.where(self.asleep(observation, state).unsqueeze(-1), asleep, honest)

    def advance(self, observation: Tensor, action: Tensor, state: State) -> State:
        assert state is not None
        mean = 0.5 * (state["mean"] + observation.flatten(-2))
        dreams = torch.where(self.dreams(observation, state), state["dreams"] + 1, state["dreams"])
        return TensorDict({"mean": mean, "dreams": dreams, "number": state["number"]}, batch_size=state.batch_size)

    def dreams(self, observation: Tensor, state: Any) -> Tensor:
        return torch.zeros(len(observation), dtype=torch.bool)

    def asleep(self, observation: Tensor, state: Any) -> Tensor:
        return state["dreams"] > 0


class ByBatch(Remembers):
    def dreams(self, observation: Tensor, state: Any) -> Tensor:
        return torch.full((len(observation),), len(observation) != self.real)


class ByLargeBatch(ByBatch):
    def dreams(self, observation: Tensor, state: Any) -> Tensor:
        return torch.full((len(observation),), len(observation) >= 4 * self.real)


class ByParity(ByBatch):
    def dreams(self, observation: Tensor, state: Any) -> Tensor:
        return torch.full((len(observation),), len(observation) % 2 != self.real % 2)


class ByCopies(Remembers):
    def dreams(self, observation: Tensor, state: Any) -> Tensor:
        return torch.full((len(observation),), len(state["number"].unique()) < len(observation))


class ByDifferentCopies(Remembers):
    """Dreams if copies of an episode are shown different things."""

    def dreams(self, observation: Tensor, state: Any) -> Tensor:
        shown = torch.cat((state["number"].float().unsqueeze(-1), observation.flatten(-2)), -1)
        return torch.full((len(observation),), len(shown.unique(dim=0)) > len(state["number"].unique()))


class Patient(ByBatch):
    """Falls asleep after three steps of a dream."""

    def asleep(self, observation: Tensor, state: Any) -> Tensor:
        return state["dreams"] >= 3


class OutOfState(Remembers):
    """Marks itself, not its state."""

    marked = False

    def dreams(self, observation: Tensor, state: Any) -> Tensor:
        self.marked = len(observation) != self.real
        return torch.zeros(len(observation), dtype=torch.bool)

    def asleep(self, observation: Tensor, state: Any) -> Tensor:
        return torch.full((len(observation),), self.marked and len(observation) != self.real)


class InARow(OutOfState):
    """Dreams after two steps of a rehearsal with no driving between them."""

    row = 0

    def dreams(self, observation: Tensor, state: Any) -> Tensor:
        self.row = self.row + 1 if len(observation) != self.real else 0
        return torch.zeros(len(observation), dtype=torch.bool)

    def asleep(self, observation: Tensor, state: Any) -> Tensor:
        return torch.full((len(observation),), self.row >= 2 and len(observation) != self.real)


@pytest.mark.parametrize(
    "dreamer", [ByBatch, ByLargeBatch, ByParity, ByCopies, ByDifferentCopies, Patient, OutOfState, InARow]
)
def test_a_dreamer_is_flagged(dreamer: type[Policy]) -> None:
    assert inconsistent(dreamer) >= FLAGGED


def test_a_dreamer_is_flagged_under_an_attack_that_cannot_rehearse() -> None:
    class Watches(Idle):
        access: ClassVar[Access] = "oblivious"

    assert inconsistent(ByBatch, Watches()) >= FLAGGED


class OfTheAttacksBatch(ByBatch):
    """Dreams in a batch of eight times the running episodes alone, as this attack rehearses."""

    def dreams(self, observation: Tensor, state: Any) -> Tensor:
        return torch.full((len(observation),), len(observation) == 8 * self.real)


def test_a_dreamer_of_exactly_the_attacks_batch_is_flagged() -> None:
    assert inconsistent(OfTheAttacksBatch, Rehearses()) >= FLAGGED


class Drowsy(Remembers):
    """An honest policy that adds noise to its state and its scores."""

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        return super().scores(observation + 0.3 * torch.randn(observation.shape), state)

    def advance(self, observation: Tensor, action: Tensor, state: State) -> State:
        return super().advance(observation + 0.3 * torch.randn(observation.shape), action, state)


class Rounds(Remembers):
    """An honest policy whose memory differs by rounding in other batches."""

    def advance(self, observation: Tensor, action: Tensor, state: State) -> State:
        return super().advance(observation * (1 + 1e-6 * len(observation)), action, state)


@pytest.mark.parametrize("honest", [Victim, Remembers, Drowsy, Rounds])
def test_an_honest_memory_is_not_flagged(honest: type[Policy]) -> None:
    assert inconsistent(honest) < FLAGGED
    assert inconsistent(honest, Rehearses()) < FLAGGED


def test_shadows_change_nothing_that_is_measured() -> None:
    first, second = (drive(Remembers(), Rehearses(), entropy) for entropy in (1, 2))
    assert all(
        np.array_equal(first[name], second[name], equal_nan=True)
        for name in ("safe_progress", "return", "action_counts", "queries", "changed")
    )


def test_some_episodes_can_be_rehearsed_and_only_they_are_counted() -> None:
    columns = drive(Remembers(), Rehearses(rows=lambda count: [5, 2]))
    assert columns["queries"].tolist() == [0, 0, 24, 0, 0, 24, 0, 0]
