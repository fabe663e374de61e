"""What an attack remembers is kept by the run, for each episode; what it may not do with it is refused."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.core.contracts import Access
from cavbench.driving import DrivingAttack, ObservationThreat, Oracle, State
from cavbench.driving.attacker import Attacker
from cavbench.driving.victim import CountedPolicy
from cavbench.errors import UserError
from tests.attacks.driving.victims import FEATURES, Linear, observations

ALL = torch.ones(3, dtype=torch.bool)


@dataclass(frozen=True, kw_only=True)
class Delay(DrivingAttack):
    """Shows what was measured one step before, and remembers the observation it was given itself."""

    access: ClassVar[Access] = "scores"

    def initial(self, observation: Tensor, oracle: Oracle) -> State:
        return TensorDict({"last": observation}, batch_size=observation.shape[:1])

    def step(self, observation: Tensor, oracle: Oracle, state: State) -> tuple[Tensor, State]:
        assert state is not None
        return state["last"], TensorDict({"last": observation}, batch_size=observation.shape[:1])


class Hasty(Delay):
    """Asks the victim before the first step."""

    def initial(self, observation: Tensor, oracle: Oracle) -> State:
        oracle.scores(observation)
        return super().initial(observation, oracle)


class Forgetful(Delay):
    """Remembers nothing in the beginning."""

    def initial(self, observation: Tensor, oracle: Oracle) -> State:
        return None

    def step(self, observation: Tensor, oracle: Oracle, state: State) -> tuple[Tensor, State]:
        return observation, TensorDict({"last": observation}, batch_size=observation.shape[:1])


def attacker(attack: DrivingAttack) -> Attacker:
    return Attacker(attack, CountedPolicy(Linear(0)), ObservationThreat(norm="linf", budget=2.0), FEATURES, seed=0)


def test_each_episode_keeps_its_own_memory_when_others_have_ended() -> None:
    steps = [observations(3, seed) for seed in range(4)]
    for observation in steps:
        observation[..., 0] = 1.0
    at_work, expected = attacker(Delay()), steps[0].clone()
    for observation, running in zip(
        steps, torch.tensor([[1, 1, 1], [1, 0, 1], [1, 0, 1], [0, 0, 1]]).bool(), strict=True
    ):
        shown = at_work.show(observation, running, None).observation
        torch.testing.assert_close(shown, torch.where(running[:, None, None], expected, observation), rtol=0, atol=0)
        expected[running] = observation[running]


def test_remembering_the_observation_itself_does_not_change_it() -> None:
    first, second = observations(3, 0), observations(3, 1)
    before = first.clone()
    at_work = attacker(Delay())
    at_work.show(first, ALL, None)
    at_work.show(second, ALL, None)
    torch.testing.assert_close(first, before, rtol=0, atol=0)


def test_nothing_is_asked_before_the_first_step() -> None:
    with pytest.raises(UserError, match=r"Hasty\.initial asked the victim"):
        attacker(Hasty()).show(observations(3, 0), ALL, None)


def test_a_state_that_would_be_lost_is_refused() -> None:
    with pytest.raises(UserError, match=r"Forgetful\.step and Forgetful\.initial must both return a state"):
        attacker(Forgetful()).show(observations(3, 0), ALL, None)
