"""The compiled belief: torch's points to the last bit and torch's gradients, in every batch, and torch where more is wanted."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from cavbench.defenses.driving.pessimist_q import Believing, PessimistQ
from cavbench.driving import Policy
from cavbench.driving.intervals import belief_kernels
from cavbench.driving.intervals.belief import Belief
from cavbench.driving.victims.networks import QPolicy
from tests.driving.intervals.compiled import (
    drives_as_by_torch,
    has_the_gradient_of_torch,
    has_the_same_bits_everywhere,
    takes_several_dimensions_and_none,
)
from tests.driving.intervals.drivers import FACTS
from tests.driving.intervals.test_mask import drawn


class Points(Policy):
    """Scores that say all about an observation: weighted sums with bends, so that every point of a belief counts."""

    action_type = "discrete"

    def forward(self, observation: Tensor) -> Tensor:
        flat = observation.flatten(-2)
        generator = torch.Generator().manual_seed(7)
        weights = torch.randn(flat.shape[-1], len(FACTS.actions), generator=generator)
        return (flat + 0.3 * flat.abs()) @ weights


def believing(policy: Policy | None = None, *, any_start: bool = False, pessimism: float = 0.7) -> Believing:
    torch.manual_seed(3)
    assert FACTS.kinematics is not None
    kinematics = replace(FACTS.kinematics, start_speed=None if any_start else FACTS.kinematics.start_speed)
    behind = policy or QPolicy(5, len(FACTS.actions), 16).requires_grad_(False)
    return Believing(PessimistQ(pessimism=pessimism), behind, replace(FACTS, kinematics=kinematics)).eval()


def by_torch() -> AbstractContextManager[object]:
    return patch.object(Belief, "fits", lambda self, observation, state: False)


class Asked(Policy):
    """Notes what it is asked."""

    action_type = "discrete"

    def forward(self, observation: Tensor) -> Tensor:
        self.asked = observation
        return observation.flatten(-2)[..., : len(FACTS.actions)]


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), any_start=st.booleans())
def test_points_are_those_of_torch_to_the_last_bit(seed: int, any_start: bool) -> None:
    policy, (shown, state) = believing(asked := Asked(), any_start=any_start), drawn(seed, 200)
    with patch.object(belief_kernels, "believe", side_effect=belief_kernels.believe) as compiled:
        scores = policy.scores(shown, state)
        assert compiled.call_count == 1
        points = asked.asked
        with by_torch():
            assert torch.equal(policy.scores(shown, state), scores)
        assert compiled.call_count == 1
    assert torch.equal(points, asked.asked)
    # The corners differ from the middle, and the reckoned ego from the shown one.
    assert float((points[1:] != points[:1]).float().mean()) > 0.2
    assert not torch.equal(points[:, :, 0, 1:].mean(0), shown[:, 0, 1:])


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), any_start=st.booleans(), network=st.booleans())
def test_gradients_are_those_of_torch(seed: int, any_start: bool, network: bool) -> None:
    policy = believing(None if network else Points(), any_start=any_start)
    shown, state = drawn(seed, 200)
    _, largest = has_the_gradient_of_torch(policy.scores, shown, state, seed, by_torch, floor=0.1)
    assert float(largest.median()) > 0.01


@pytest.mark.parametrize("pessimism", [0.0, 0.7, 1.0])
def test_the_least_value_and_its_gradient_are_those_of_torch_to_the_last_bit(pessimism: float) -> None:
    generator = torch.Generator().manual_seed(1)
    # Few different values: the least one is often shared by several points.
    values = torch.randint(-3, 9, (50, 16, 5), generator=generator).div(7).requires_grad_()
    by_scores = torch.randn(50, 5, generator=generator)
    middle, lowest = values[:, 0], values.amin(1)
    expected = middle + pessimism * (lowest - middle)
    (slope,) = torch.autograd.grad(expected, values, by_scores)
    given, weight = values.detach().numpy(), np.float32(pessimism)
    scores, by_values = np.empty((50, 5), np.float32), np.empty((50, 16, 5), np.float32)
    belief_kernels.least(given, weight, scores)
    belief_kernels.least_backward(by_scores.numpy(), given, weight, by_values)
    assert torch.equal(torch.from_numpy(scores), expected)
    assert torch.equal(torch.from_numpy(by_values), slope)
    assert bool(((values == lowest.unsqueeze(1)).sum(1) > 1).any())


def test_a_value_that_is_nan_is_the_least() -> None:
    values = np.zeros((2, 16, 5), np.float32)
    values[0, 3, 1] = values[1, 0, 2] = np.nan
    scores, by_values = np.empty((2, 5), np.float32), np.empty_like(values)
    belief_kernels.least(values, np.float32(1), scores)
    belief_kernels.least_backward(np.ones((2, 5), np.float32), values, np.float32(1), by_values)
    where = np.argwhere(np.isnan(scores)).tolist()
    assert where == [[0, 1], [1, 2]]
    assert np.isnan(by_values).any(1).tolist() == np.isnan(scores).tolist()


def test_a_row_has_the_same_bits_in_every_batch_and_place() -> None:
    policy = believing()
    has_the_same_bits_everywhere(policy.scores, *drawn(1, 120))


def test_several_leading_dimensions_and_no_points_are_answered() -> None:
    policy = believing()
    takes_several_dimensions_and_none(policy.scores, *drawn(2, 60))


def test_a_tracked_belief_drives_as_by_torch() -> None:
    drives_as_by_torch(believing(), drawn(5, 80)[0], by_torch)
