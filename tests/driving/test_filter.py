"""A filter changes what the policy behind it sees: in every question, with a gradient, and with what both remember."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.core import registry
from cavbench.defenses.driving.frame_stack import FrameStack
from cavbench.driving import DrivingFacts, DrivingWorld, ObservationFilter, Policy, State
from cavbench.driving.filter import FilteredPolicy
from cavbench.driving.victims.reference import Blind
from tests.attacks.driving.victims import observations, victim
from tests.driving.policies import FACTS, Echo, Given


@dataclass(frozen=True, kw_only=True)
class Rounds(ObservationFilter):
    def filter(self, observation: Tensor) -> Tensor:
        return torch.cat((observation[..., :1], (observation[..., 1:] * 4).round() / 4), -1)


@dataclass(frozen=True, kw_only=True)
class Halves(ObservationFilter):
    differentiable = True

    def filter(self, observation: Tensor) -> Tensor:
        return torch.cat((observation[..., :1], observation[..., 1:] / 2), -1)


@dataclass(frozen=True, kw_only=True)
class Counts(ObservationFilter):
    """Adds the number of observations before; the gradient does not go through it."""

    def step(self, observation: Tensor, memory: State) -> tuple[Tensor, State]:
        count = torch.zeros(observation.shape[:-2]) if memory is None else memory["count"]
        return observation + count[..., None, None], TensorDict({"count": count + 1}, batch_size=count.shape)


@dataclass(frozen=True, kw_only=True)
class Nothing(ObservationFilter):
    """It forgets to say what it does."""


@dataclass(frozen=True, kw_only=True)
class KnowsTheRoad(ObservationFilter):
    def filter(self, observation: Tensor) -> Tensor:
        return observation * len(self.facts.features.names)


def behind(defense: ObservationFilter, policy: Policy, facts: DrivingFacts = FACTS) -> FilteredPolicy:
    found = defense.load(Given(policy=policy), 0, facts)
    assert isinstance(found, FilteredPolicy)
    return found


@pytest.mark.parametrize("leading", [(), (3,), (2, 3)])
def test_scores_and_value_are_those_of_the_filtered_observation(leading: tuple[int, ...]) -> None:
    inner = victim("continuous")
    seen = observations(4, 0).expand(*leading, 4, -1, -1)
    rounded, action = Rounds().filter(seen), torch.zeros(*leading, 4, 2)
    policy = behind(Rounds(), inner)
    torch.testing.assert_close(policy.scores(seen), inner.scores(rounded))
    torch.testing.assert_close(policy.value(seen, action), inner.value(rounded, action))


def test_without_a_memory_anywhere_there_is_no_state() -> None:
    assert behind(Rounds(), Echo()).initial(torch.arange(3)) is None


def test_a_gradient_passes_straight_through_unless_the_filter_has_one() -> None:
    inner, shown = victim("discrete"), observations(4, 0).requires_grad_(True)
    for defense, factor in ((Rounds(), 1.0), (Halves(), 0.5)):
        seen = defense.filter(shown.detach()).requires_grad_(True)
        (found,) = torch.autograd.grad(behind(defense, inner).scores(shown).square().sum(), shown)
        (wanted,) = torch.autograd.grad(inner.scores(seen).square().sum(), seen)
        assert bool(wanted.any())
        torch.testing.assert_close(found[..., 1:], factor * wanted[..., 1:])


def test_the_policy_behind_it_keeps_its_memory() -> None:
    alone = Blind().load(0, FACTS)
    for defense in (Rounds(), Counts()):
        policy = behind(defense, alone)
        own, state = alone.initial(torch.arange(3)), policy.initial(torch.arange(3))
        for step in range(20):
            observation = observations(3, step)
            action = alone.decide(observation, own)
            assert torch.equal(policy.decide(observation, state), action)
            own, state = alone.advance(observation, action, own), policy.advance(observation, action, state)


def test_a_memory_changes_once_a_step_however_often_it_is_asked() -> None:
    policy, observation = behind(Counts(), Echo()), observations(3, 0)
    state = policy.initial(torch.arange(3))
    for step in range(4):
        for _ in range(3):
            assert torch.equal(policy.scores(observation, state), (observation + step).flatten(-2))
        state = policy.advance(observation, torch.zeros(3, dtype=torch.int64), state)


def test_what_reaches_a_policy_in_training_is_filtered_by_all_filters() -> None:
    seen = observations(4, 0)
    policy = behind(Halves(), behind(Rounds(), Echo()))
    assert torch.equal(policy.passed(seen).observation, Rounds().filter(Halves().filter(seen)))


def test_no_driver_is_trained_behind_a_filter_with_a_memory() -> None:
    """A training begins episodes at different times, and the memory of a new one would be that of the one before."""
    policy = behind(FrameStack(), Echo())
    with pytest.raises(NotImplementedError, match="FrameStack does not say what it passes on"):
        policy.passed(observations(4, 0), policy.initial(torch.arange(4)))


def test_a_filter_knows_the_world_that_it_is_loaded_for_and_no_other() -> None:
    world: DrivingWorld = registry.load("world", "highway")()
    defense, seen = KnowsTheRoad(), observations(2, 0)
    torch.testing.assert_close(behind(defense, Echo(), world.facts).scores(seen), 4 * seen.flatten(-2))
    assert not hasattr(defense, "facts")


def test_a_filter_that_filters_nothing_misses_a_method() -> None:
    assert Nothing.missing() == ["filter or step"]
    assert Rounds.missing() == Counts.missing() == []


@dataclass(frozen=True, kw_only=True)
class FirstCar(ObservationFilter):
    def filter(self, observation: Tensor) -> Tensor:
        return observation[..., :1, :]


@dataclass(frozen=True, kw_only=True)
class FirstCarDifferentiably(FirstCar):
    differentiable = True


@pytest.mark.parametrize("defense", [FirstCar(), FirstCarDifferentiably()])
def test_an_answer_of_another_shape_is_refused_not_repeated(defense: ObservationFilter) -> None:
    with pytest.raises(ValueError, match=r"the filter FirstCar.* of that shape"):
        behind(defense, Echo()).scores(observations(2, 0))
