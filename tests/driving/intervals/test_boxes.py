"""The boxes of a shown observation hold the truth."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cavbench.driving import ObservationThreat
from cavbench.driving.intervals.boxes import Assumed
from cavbench.driving.threat import Norm
from tests.attacks.driving.victims import observations
from tests.driving.intervals.drivers import FACTS


@pytest.mark.parametrize("norm", ["relative", "linf"])
@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 10_000), budget=st.sampled_from([0.0, 0.05, 0.1, 0.3]), noise=st.sampled_from([0.0, 0.1, 0.5])
)
def test_the_boxes_of_any_shown_observation_hold_the_truth(norm: Norm, seed: int, budget: float, noise: float) -> None:
    truth, generator = observations(4, seed).clamp(-1, 1), torch.Generator().manual_seed(seed)
    threat = ObservationThreat(norm=norm, budget=budget)
    # The sensor is wrong about the other cars' x and vx; what it measures is then perturbed.
    off = noise * (2 * torch.rand(truth.shape, generator=generator) - 1)
    off[..., 0, :] = off[..., [0, 2, 4]] = 0.0
    off[..., 1:] /= FACTS.features.half_range()
    measured = (truth + off).clamp(-1, 1)
    share = torch.rand(truth.shape, generator=generator) * 2 - 1
    radius = threat.radius(measured, FACTS.features)
    shown = (measured + share.sign() * share.abs().sqrt() * radius).clamp(-1, 1)
    boxes = Assumed(FACTS.features, norm, budget, noise).boxes(shown)
    physical = truth[..., 1:] * FACTS.features.half_range()
    present = boxes.present.unsqueeze(-1)
    assert bool(((boxes.low <= physical + 1e-4) & (physical <= boxes.high + 1e-4) | ~present).all())
