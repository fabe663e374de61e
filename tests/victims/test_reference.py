"""The drivers that learn nothing."""

from __future__ import annotations

import torch

from bench.victims.drivers.reference import FASTER, LANE_RIGHT, RIGHT_STEPS, SLOWER, Blind, IDMDriver, RandomDriver


def test_a_blind_driver_does_not_look() -> None:
    policy = Blind(policy="faster").load(0)
    assert policy.decide(torch.rand(6, 10, 5)).tolist() == [FASTER] * 6
    assert Blind(policy="brake").load(0).decide(torch.rand(2, 10, 5)).tolist() == [[-1.0, 0.0]] * 2


def test_right_then_slower_changes_lanes_first_and_again_after_a_reset() -> None:
    policy, x = Blind().load(0), torch.zeros(1, 10, 5)
    for _ in range(2):
        policy.reset(torch.zeros(1))
        actions = [int(policy.decide(x)) for _ in range(RIGHT_STEPS + 5)]
        assert actions == [LANE_RIGHT] * RIGHT_STEPS + [SLOWER] * 5


def test_random_actions_depend_on_the_scenario_seed_alone() -> None:
    policy, x = RandomDriver().load(0), torch.zeros(3, 10, 5)
    policy.reset(torch.tensor([7, 8, 9]))
    together = torch.stack([policy.decide(x) for _ in range(50)])
    policy.reset(torch.tensor([8]))
    alone = torch.stack([policy.decide(x[:1]) for _ in range(50)])
    assert torch.equal(together[:, 1], alone[:, 0])
    assert set(together.flatten().tolist()) == set(range(5))


def test_random_continuous_actions_fill_their_range() -> None:
    policy = RandomDriver(actions="continuous").load(0)
    policy.reset(torch.arange(50))
    actions = torch.stack([policy.decide(torch.zeros(50, 10, 5)) for _ in range(50)])
    assert actions.shape == (50, 50, 2)
    assert actions.min() < -0.9
    assert actions.max() > 0.9


def test_idm_leaves_the_wheel_to_the_world() -> None:
    assert IDMDriver().load(0).driver == "idm"
    assert not IDMDriver.sees
