"""A timed attack is the attack in the episodes where the victim prefers one action, and the truth in the others."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cavbench.attacks.driving.pgd import PGD
from cavbench.attacks.driving.timing import preference_gap
from cavbench.core.pair import choose
from cavbench.driving import ActionType
from cavbench.driving.contracts import DrivingVictim
from tests.attacks.driving.victims import observations, perturb, victim

OPTIONS: dict[str, Any] = {"steps": 3, "restarts": 2, "gap_temperature": 1.0}


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 999), place=st.integers(0, 7))
def test_only_episodes_above_the_gap_are_attacked_and_pay(seed: int, place: int) -> None:
    policy, observation = victim("discrete", seed), observations(8, seed)
    gaps = preference_gap(policy.scores(observation), 1.0)
    least = float(gaps[place])
    shown, spent = perturb(PGD(**OPTIONS, gap=least), policy, observation)
    always, full = perturb(PGD(**OPTIONS), policy, observation)
    chosen = gaps >= least
    assert bool(chosen[place])
    assert torch.equal(shown[~chosen], observation[~chosen])
    torch.testing.assert_close(shown[chosen], always[chosen])
    assert spent.tolist() == torch.where(chosen, full, 1).tolist()


@pytest.mark.parametrize(("name", "action_type"), [("dqn", "discrete"), ("ddpg", "continuous")])
def test_a_gap_fits_discrete_victims_only(name: str, action_type: ActionType) -> None:
    component = choose("victim", name).component
    assert isinstance(component, DrivingVictim)
    assert component.action_type == action_type
    assert PGD().misfit(component) == ""
    assert bool(PGD(gap=0.1).misfit(component)) == (action_type == "continuous")
