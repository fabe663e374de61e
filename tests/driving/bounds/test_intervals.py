"""Interval bounds to train with: those of the certificate, and with a gradient."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from cavbench.core.pair import choose
from cavbench.driving.bounds.intervals import leads
from cavbench.driving.bounds.networks import BoundedNetwork
from cavbench.driving.threat import ObservationThreat, bounds
from cavbench.driving.victims.networks import QPolicy
from tests.driving.bounds.test_networks import FEATURES, WORLD, seen


def boxes(budget: float) -> tuple[Tensor, Tensor]:
    observation = seen(12)
    return bounds(observation, ObservationThreat(budget=budget).radius(observation, FEATURES))


@pytest.mark.parametrize("budget", [0.0, 0.02, 0.5])
def test_they_are_those_of_the_certificate(budget: float) -> None:
    policy = choose("victim", "dqn").component.load(0, WORLD.facts)
    found, known = leads(policy.network, *boxes(budget)), BoundedNetwork(policy).leads(*boxes(budget)).interval
    torch.testing.assert_close(found.double(), known, rtol=1e-3, atol=1e-5)


def test_steps_along_their_gradient_tighten_them() -> None:
    torch.manual_seed(0)
    network, box = QPolicy(5, 5, 16).network, boxes(0.1)
    adam, found = torch.optim.Adam(network.parameters(), 1e-3), []
    for _ in range(30):
        lead = leads(network, *box)
        # The upper bound of Q_i - Q_j is minus the lower one of Q_j - Q_i.
        width = -(lead + lead.mT).mean()
        found.append(float(width))
        adam.zero_grad()
        width.backward()
        adam.step()
    assert 0 < found[-1] < 0.5 * found[0]
