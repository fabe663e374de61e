"""Robust Sarsa: the critic alone decides what is induced."""

from __future__ import annotations

import pytest
import torch

from cavbench.attacks.driving.pgd import PGD
from cavbench.attacks.driving.sarsa import RobustSarsa, Value
from tests.attacks.driving.victims import observations, perturb, victim


def test_the_critic_alone_decides_what_sarsa_induces() -> None:
    """For a critic with one bad action, it induces that action about as often as PGD towards it."""
    policy, seen = victim("discrete", 3), observations(40, 3)
    clean, by_sarsa, by_pgd = 0.0, 0.0, 0.0
    for bad in range(5):
        critic = Value(5, 5, 4, 0.1)
        with torch.no_grad():
            for weight in critic.parameters():
                weight.zero_()
            critic.network.head[-1].bias[1 + bad] = -1.0
        shown = [
            seen,
            perturb(RobustSarsa().armed(critic), policy, seen)[0],
            perturb(PGD(objective="target", target_action=bad), policy, seen)[0],
        ]
        taken = [float((policy.decide(each) == bad).float().mean()) for each in shown]
        clean, by_sarsa, by_pgd = clean + taken[0], by_sarsa + taken[1], by_pgd + taken[2]
    assert clean == pytest.approx(1.0)
    assert by_pgd > 1.2
    assert by_sarsa - clean >= 0.7 * (by_pgd - clean)
