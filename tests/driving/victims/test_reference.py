"""The baseline drivers, which ignore their input."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from cavbench.driving import DrivingFacts, ObservationThreat, Policy
from cavbench.driving.meter import Columns
from cavbench.driving.rollout import rollout
from cavbench.driving.victims.reference import Blind, ClairvoyantDriver, IDMDriver, RandomDriver
from cavbench.envs.highway.world import HighwayWorld
from cavbench.errors import UserError
from cavbench.scenarios import SeedBlock

FACTS = HighwayWorld().facts
LANE_LEFT, IDLE, LANE_RIGHT, FASTER, SLOWER = range(5)
RIGHT_STEPS = 60


def driven(policy: Policy, episodes: Tensor, steps: int) -> Tensor:
    """[steps, B] or [steps, B, 2] the actions of a driver, step by step."""
    x, state, actions = torch.zeros(len(episodes), 10, 5), policy.initial(episodes), []
    for _ in range(steps):
        actions.append(policy.decide(x, state))
        state = policy.advance(x, actions[-1], state)
    return torch.stack(actions)


def test_a_blind_driver_ignores_the_observation() -> None:
    policy = Blind(policy="faster").load(0, FACTS)
    assert policy.decide(torch.rand(6, 10, 5)).tolist() == [FASTER] * 6
    assert Blind(policy="brake").load(0, FACTS).decide(torch.rand(2, 10, 5)).tolist() == [[-1.0, 0.0]] * 2


def test_right_then_slower_changes_lanes_first_and_again_in_the_next_episode() -> None:
    policy = Blind().load(0, FACTS)
    for _ in range(2):
        actions = driven(policy, torch.zeros(1, dtype=torch.int64), RIGHT_STEPS + 5)
        assert actions.flatten().tolist() == [LANE_RIGHT] * RIGHT_STEPS + [SLOWER] * 5


def test_right_then_slower_takes_four_seconds_at_any_decision_rate() -> None:
    slow = HighwayWorld(policy_frequency=5).facts
    actions = driven(Blind().load(0, slow), torch.zeros(1, dtype=torch.int64), 21)
    assert actions.flatten().tolist() == [LANE_RIGHT] * 20 + [SLOWER]


def test_the_blind_policies_are_those_of_the_worlds_own_actions() -> None:
    three = DrivingFacts(
        axes=FACTS.axes, decision_hz=5, max_steps=10, actions=("LEFT", "STAY", "RIGHT"), features=FACTS.features
    )
    assert three.blind_policies("discrete") == ["left", "stay", "right"]
    assert driven(Blind(policy="right").load(0, three), torch.zeros(1, dtype=torch.int64), 1).tolist() == [[2]]
    with pytest.raises(UserError, match="did you mean"):
        Blind(policy="lane_right").load(0, three)


def test_perfect_information_drives_fast_and_safely_whoever_else_is_in_the_batch() -> None:
    world = HighwayWorld(max_steps=90)
    cells = [world.axes.cell(lanes=lanes, density=2.0, weather="clear") for lanes in (3, 4, 3)]
    policy = ClairvoyantDriver().load(0, world.facts)

    def scored(places: list[int]) -> Columns:
        env = world.make([cells[place] for place in places], driver=policy.driver)
        seeds = [SeedBlock.TRAIN + place for place in places]
        return rollout(env, policy, None, ObservationThreat(budget=0.0), seeds, facts=world.facts, attack_seed=0)

    together, alone = scored([0, 1, 2]), scored([1])
    assert not together["crashed"].any()
    assert together["safe_progress"].mean() > 0.6
    assert together["return"][1] == alone["return"][0]


def test_no_other_world_has_perfect_information() -> None:
    with pytest.raises(UserError, match="perfect information"):
        ClairvoyantDriver().load(0, HighwayWorld(backend="reference").facts)


def test_random_actions_depend_on_the_episode_alone() -> None:
    policy = RandomDriver().load(0, FACTS)
    together, alone = driven(policy, torch.tensor([7, 8, 9]), 50), driven(policy, torch.tensor([8]), 50)
    assert torch.equal(together[:, 1], alone[:, 0])
    assert set(together.flatten().tolist()) == set(range(5))


def test_random_continuous_actions_fill_their_range() -> None:
    actions = driven(RandomDriver(actions="continuous").load(0, FACTS), torch.arange(50), 50)
    assert actions.shape == (50, 50, 2)
    assert actions.min() < -0.9
    assert actions.max() > 0.9


def test_idm_uses_the_worlds_own_driver() -> None:
    assert IDMDriver().load(0, FACTS).driver == "idm"
    assert not IDMDriver.sees
