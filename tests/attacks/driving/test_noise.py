"""Noise: its distribution, and that it makes no queries."""

from __future__ import annotations

import pytest
import torch

from cavbench.attacks.driving.noise import Distribution, Noise
from cavbench.driving import ObservationThreat
from tests.attacks.driving.victims import FEATURES, observations, perturb, victim


@pytest.mark.parametrize("distribution", ["uniform", "gaussian"])
def test_noise_makes_no_queries(distribution: Distribution) -> None:
    _, spent = perturb(Noise(distribution=distribution), victim("discrete"), observations(8))
    assert int(spent.sum()) == 0


@pytest.mark.parametrize(
    ("distribution", "scale", "deviation"),
    # Uniform on +-r: r / sqrt 3. A normal variable of half the radius cut off at the radius: its known second moment.
    [("uniform", 1.0, 0.577), ("uniform", 0.5, 0.289), ("gaussian", 0.25, 0.25), ("gaussian", 0.5, 0.480)],
)
def test_noise_has_the_documented_width(distribution: Distribution, scale: float, deviation: float) -> None:
    threat = ObservationThreat(norm="linf", budget=0.1)
    # Far from the ends of the sensors' range, which cut noise off as well.
    observation = observations(2000) * torch.tensor([1.0, 0.5, 0.5, 0.5, 0.5])
    shown, _ = perturb(Noise(distribution=distribution, scale=scale), victim("discrete"), observation, threat)
    radius = threat.radius(observation, FEATURES)
    share = ((shown - observation) / radius)[radius > 0]
    assert abs(float(share.mean())) < 0.01
    assert float(share.std()) == pytest.approx(deviation, rel=0.02)


def test_noise_differs_between_episodes() -> None:
    observation = observations(1).expand(2, -1, -1)
    shown, _ = perturb(Noise(), victim("discrete"), observation)
    assert not torch.equal(shown[0], shown[1])
