"""The compiled driver by rules: torch's answers to the last bit and torch's gradients, in every batch."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import replace
from unittest.mock import patch

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor

from cavbench.driving.intervals import worth_kernels
from cavbench.driving.intervals.worth import Worth
from cavbench.driving.victims.planner import FORBIDDEN, IntervalPlanner, Planner
from tests.driving.intervals.compiled import (
    drives_as_by_torch,
    has_the_gradient_of_torch,
    has_the_same_bits_everywhere,
    takes_several_dimensions_and_none,
)
from tests.driving.intervals.drivers import FACTS
from tests.driving.intervals.test_mask import drawn


def planner(*, any_start: bool = False) -> IntervalPlanner:
    assert FACTS.kinematics is not None
    kinematics = replace(FACTS.kinematics, start_speed=None if any_start else FACTS.kinematics.start_speed)
    return IntervalPlanner(Planner(), replace(FACTS, kinematics=kinematics)).eval()


def by_torch() -> AbstractContextManager[object]:
    return patch.object(Worth, "fits", lambda self, observation, state: False)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), any_start=st.booleans())
def test_answers_are_those_of_torch_to_the_last_bit(seed: int, any_start: bool) -> None:
    policy, (shown, state) = planner(any_start=any_start), drawn(seed, 300)
    boxes = policy.assumed.boxes(shown)
    with patch.object(worth_kernels, "worth", side_effect=worth_kernels.worth) as compiled:
        found = policy.weighed(shown, boxes, state), policy.safe(boxes, state)
        assert compiled.call_count == 2
        with by_torch():
            wanted = policy.weighed(shown, boxes, state), policy.safe(boxes, state)
        assert compiled.call_count == 2
    for one, other in zip(found, wanted, strict=True):
        assert torch.equal(one, other)
    # The states above reach what the driver decides about.
    assert 0.1 < float(wanted[1].float().mean()) < 0.95
    assert 0.1 < float((wanted[0] == FORBIDDEN).float().mean()) < 0.9


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), any_start=st.booleans())
def test_gradients_are_those_of_torch(seed: int, any_start: bool) -> None:
    policy, (shown, state) = planner(any_start=any_start), drawn(seed, 300)

    def answer(asked: Tensor, known: TensorDict) -> Tensor:
        return policy.weighed(asked, policy.assumed.boxes(asked), known)

    apart, largest = has_the_gradient_of_torch(answer, shown, state, seed, by_torch, floor=0.1)
    assert float((apart <= 1e-6 * largest).float().mean()) > 0.97
    assert float((largest > 1e-3).float().mean()) > 0.4


def test_a_row_has_the_same_bits_in_every_batch_and_place() -> None:
    policy = planner()
    has_the_same_bits_everywhere(
        lambda asked, known: policy.weighed(asked, policy.assumed.boxes(asked), known), *drawn(1, 120)
    )


def test_several_leading_dimensions_and_no_points_are_answered() -> None:
    policy = planner()
    takes_several_dimensions_and_none(
        lambda asked, known: policy.weighed(asked, policy.assumed.boxes(asked), known), *drawn(2, 60)
    )


def test_torch_answers_for_another_precision() -> None:
    policy, (shown, state) = planner(), drawn(4, 40)
    asked = shown.double()
    with patch.object(worth_kernels, "worth", side_effect=worth_kernels.worth) as compiled:
        scores = policy.weighed(asked, policy.assumed.boxes(asked), state)
    assert compiled.call_count == 0
    # The rooms of both are computed in float32.
    torch.testing.assert_close(
        scores.float(), policy.weighed(shown, policy.assumed.boxes(shown), state), atol=1e-4, rtol=1e-4
    )


def test_a_tracked_driver_drives_as_by_torch() -> None:
    drives_as_by_torch(planner(), drawn(5, 80)[0], by_torch)
