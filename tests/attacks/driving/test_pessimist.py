"""The pessimist's attack uses the whole budget, in the same direction at every step, and asks nothing."""

from __future__ import annotations

import pytest
import torch

from cavbench.attacks.driving.pessimist import Outlook, Pessimist
from cavbench.driving import Features, ObservationThreat
from cavbench.driving.access import Enforcer
from cavbench.driving.victim import CountedPolicy
from tests.attacks.driving.victims import FEATURES, observations, perturb, victim

THREAT = ObservationThreat(budget=0.1)


@pytest.mark.parametrize(("outlook", "sign"), [("pessimist", 1), ("optimist", -1)])
def test_every_car_is_nearer_and_closes_faster_by_the_whole_budget(outlook: Outlook, sign: int) -> None:
    truth = observations(20)
    truth[..., 1:] *= 0.8  # Within the sensors' range with any offset.
    shown, spent = perturb(Pessimist(outlook=outlook), victim("discrete"), truth, THREAT)
    radius, offset = THREAT.radius(truth, FEATURES), shown - truth
    cars, present = slice(1, None), truth[:, 1:, 0] > 0
    side = torch.where(truth[:, cars, 1] < 0, 1.0, -1.0) * sign
    for feature in (1, 3):
        expected = (side * radius[:, cars, feature]).where(present, 0)
        torch.testing.assert_close(offset[:, cars, feature], expected)
    assert not offset[..., [0, 2, 4]].any()
    assert not offset[:, 0].any()
    assert not spent.any()


def test_the_error_is_the_same_share_at_every_step() -> None:
    # A car 40 m ahead that falls back by 5 m/s; a step is 1/15 s.
    frames = torch.zeros(30, 2, 5)
    frames[:, :, 0] = 1.0
    frames[:, 1, 1] = (40 - 5 * torch.arange(30) / 15) / 100
    frames[:, 1, 3] = -5 / 40
    shown, _ = perturb(Pessimist(), victim("discrete"), frames, THREAT)
    torch.testing.assert_close(shown[:, 1, 1], 0.9 * frames[:, 1, 1])
    torch.testing.assert_close(shown[:, 1, 3], 1.1 * frames[:, 1, 3])


def test_a_world_without_distances_is_refused_in_one_line() -> None:
    features = Features(names=("gap",), low=(0.0,), high=(1.0,), units=("m",))
    attack = Pessimist()
    enforcer = Enforcer(CountedPolicy(victim("discrete")), THREAT, attack.access, features, torch.Generator())
    oracle = enforcer.begin(torch.ones(1, 2, 2))
    with pytest.raises(ValueError, match="needs the features x and vx, the world measures gap"):
        attack.perturb(torch.ones(1, 2, 2), oracle)
