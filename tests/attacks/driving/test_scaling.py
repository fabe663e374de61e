"""The scaling attack shows possible motions, within the budget, and asks nothing."""

from __future__ import annotations

import pytest
import torch

from cavbench.attacks.driving.scaling import Scaling
from cavbench.driving import ObservationThreat
from tests.attacks.driving.victims import FEATURES, observations, perturb, victim

THREAT = ObservationThreat(budget=0.1)


@pytest.mark.parametrize(("outlook", "factor"), [("farther", 1.1), ("nearer", 0.9)])
def test_distance_and_relative_speed_have_one_factor(outlook, factor: float) -> None:
    truth = observations(20)
    truth[..., 1:] *= 0.8
    shown, spent = perturb(Scaling(outlook=outlook), victim("discrete"), truth, THREAT)
    for feature in (1, 3):
        torch.testing.assert_close(shown[:, 1:, feature], factor * truth[:, 1:, feature])
    assert torch.equal(shown[..., [0, 2, 4]], truth[..., [0, 2, 4]])
    assert torch.equal(shown[:, 0], truth[:, 0])
    assert not spent.any()
    radius = THREAT.radius(truth, FEATURES)
    assert ((shown - truth).abs() <= radius + 1e-6).all()


def test_the_shown_way_is_the_integral_of_the_shown_speed() -> None:
    # A car 40 m ahead that falls back by 5 m/s; a step is 1/15 s.
    frames = torch.zeros(30, 2, 5)
    frames[:, :, 0] = 1.0
    frames[:, 1, 1] = (40 - 5 * torch.arange(30) / 15) / 100
    frames[:, 1, 3] = -5 / 40
    shown, _ = perturb(Scaling(), victim("discrete"), frames, THREAT)
    way = (shown[1:, 1, 1] - shown[:-1, 1, 1]) * 100
    torch.testing.assert_close(way, shown[1:, 1, 3] * 40 / 15)
