"""The compiled filter: torch's answers to the last bit and torch's gradients, in every batch, and torch where more is wanted."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import replace
from unittest.mock import patch

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor

from cavbench.defenses.driving import shield
from cavbench.defenses.driving.shield import Shield, Shielded
from cavbench.driving import Policy, State
from cavbench.driving.intervals import filter_kernels
from cavbench.driving.intervals.boxes import Boxes
from cavbench.driving.intervals.ego import Ego, reckoned
from cavbench.driving.intervals.mask import Mask
from cavbench.driving.victims.networks import QPolicy
from tests.driving.intervals import by_torch as by_torch_code
from tests.driving.intervals.compiled import (
    drives_as_by_torch,
    has_the_gradient_of_torch,
    has_the_same_bits_everywhere,
    takes_several_dimensions_and_none,
)
from tests.driving.intervals.drivers import FACTS

ROWS = 6


def shielded(policy: Policy | None = None, *, any_start: bool = False) -> Shielded:
    """A filter, in a world where the ego starts at the world's speed, or at any."""
    torch.manual_seed(3)
    assert FACTS.kinematics is not None
    kinematics = replace(FACTS.kinematics, start_speed=None if any_start else FACTS.kinematics.start_speed)
    behind = policy or QPolicy(5, len(FACTS.actions), 16).requires_grad_(False)
    return Shielded(Shield(), behind, replace(FACTS, kinematics=kinematics)).eval()


def drawn(seed: int, count: int) -> tuple[Tensor, TensorDict]:
    """Observations and states with cars on every side, and with what makes a kink: rows that are missing or at the end of the
    sensor's range, egos that are unknown, between two lanes, as fast as they want to be, or off from what was measured."""
    generator = torch.Generator().manual_seed(seed)

    def among(*values: float) -> Tensor:
        return torch.tensor(values)[torch.randint(len(values), (count,), generator=generator)]

    def between(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(count, *shape, generator=generator)

    lane, speed = among(0, 1, 2, 3), torch.where(among(0, 1) > 0, among(20, 25, 30), between(10, 32))
    ego = Ego(
        y=4 * lane + among(0, 0, 0.3, -0.8, 1.5, -2.0, 3.0),
        heading=among(0, 0, 0.05, -0.2),
        speed=speed,
        target_lane=lane,
        target_speed=among(20, 25, 30),
        edge=among(2, 3, 64).maximum(lane),
    )
    place, width = (
        torch.stack([between(-40, 80, ROWS), 4 * between(-2, 3, ROWS).floor()], -1),
        FACTS.features.half_range(),
    )
    motion = torch.stack([between(-8, 8, ROWS), among(0, 0.4, -1.5)[:, None].expand(-1, ROWS)], -1)
    shown = torch.cat((place, motion), -1) / width
    measured = torch.stack([among(0.3, 1, -0.5), ego.y / width[1], ego.speed / width[2], ego.heading], -1)
    shown[:, 0] = measured + among(0, 0, 0.01, -0.1, 0.1)[:, None]
    present = (torch.rand(count, ROWS, generator=generator) < 0.8) | (torch.arange(ROWS) == 0)
    present[: count // 8, 1:] = False
    shown = torch.cat((present.float().unsqueeze(-1), torch.where(present.unsqueeze(-1), shown.clamp(-1, 1), 0.0)), -1)
    known = among(0, 1, 1, 1) > 0
    return shown, TensorDict({"ego": reckoned(ego, known)}, [count])


def by_torch() -> AbstractContextManager[object]:
    return patch.object(Mask, "fits", lambda self, observation, state: False)


def found(policy: Shielded, shown: Tensor, boxes: Boxes, state: TensorDict) -> list[Tensor]:
    """The scores, what is passed on, what is left, and whether any action is safe."""
    return [policy.weighed(shown, boxes, state), *policy.filtered(shown, boxes, state), policy.safe(boxes, state)]  # type: ignore[list-item]


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), any_start=st.booleans())
def test_answers_are_those_of_torch_to_the_last_bit(seed: int, any_start: bool) -> None:
    policy, (shown, state) = shielded(any_start=any_start), drawn(seed, 300)
    boxes = policy.assumed.boxes(shown)
    with patch.object(filter_kernels, "weigh", side_effect=filter_kernels.weigh) as compiled:
        compiled_ones = found(policy, shown, boxes, state)
        assert compiled.call_count == 3
        with by_torch():
            reference = found(policy, shown, boxes, state)
        assert compiled.call_count == 3
    for one, other in zip(compiled_ones, reference, strict=True):
        assert torch.equal(one, other)
    margins = policy.mask(shown, boxes, state["ego"])
    judged = policy.margins(policy.ego(boxes, state), boxes)
    assert torch.equal(margins.margins, torch.cat((judged.stay, judged.worth_changing), -1))
    assert torch.equal(margins.safe, judged.safe)
    # The states above reach what a filter decides about.
    assert 0.1 < float(judged.safe.float().mean()) < 0.95
    assert 0.1 < float(margins.hard.mean()) < 0.9


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), any_start=st.booleans())
def test_gradients_are_those_of_torch(seed: int, any_start: bool) -> None:
    policy, (shown, state) = shielded(any_start=any_start), drawn(seed, 300)

    def answer(asked: Tensor, known: TensorDict) -> Tensor:
        return policy.weighed(asked, policy.assumed.boxes(asked), known)

    apart, largest = has_the_gradient_of_torch(answer, shown, state, seed, by_torch, floor=1.0)
    assert float((apart <= 1e-6 * largest).float().mean()) > 0.97
    assert float(largest.median()) > 0.1


def test_a_row_has_the_same_bits_in_every_batch_and_place() -> None:
    policy = shielded()
    has_the_same_bits_everywhere(
        lambda asked, known: policy.weighed(asked, policy.assumed.boxes(asked), known), *drawn(1, 120)
    )


def test_several_leading_dimensions_and_no_points_are_answered() -> None:
    policy = shielded()
    takes_several_dimensions_and_none(
        lambda asked, known: policy.weighed(asked, policy.assumed.boxes(asked), known), *drawn(2, 60)
    )


@pytest.mark.parametrize("wanted", [torch.float64, torch.float32])
def test_torch_answers_for_another_precision(wanted: torch.dtype) -> None:
    class Wide(Policy):
        action_type = "discrete"

        def forward(self, observation: Tensor) -> Tensor:
            return observation.flatten(-2)[..., : len(FACTS.actions)].double()

    policy, (shown, state) = shielded(Wide()), drawn(4, 40)
    asked = shown.to(wanted)
    with patch.object(filter_kernels, "weigh", side_effect=filter_kernels.weigh) as compiled:
        scores = policy.weighed(asked, policy.assumed.boxes(asked), state)
        assert compiled.call_count == (wanted == torch.float32)
    assert scores.dtype == torch.float64
    with by_torch():
        torch.testing.assert_close(scores, policy.weighed(asked, policy.assumed.boxes(asked), state))


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_boxes_within_tracks_and_their_gradients_are_those_of_torch(seed: int) -> None:
    assumed, (shown, _) = shielded().assumed, drawn(seed, 100)
    generator = torch.Generator().manual_seed(seed)
    near = assumed.boxes(shown)
    shift = torch.randn(100, ROWS - 1, 4, generator=generator)
    low, high = near.low[:, 1:] + shift, near.high[:, 1:] + shift * torch.rand(shift.shape, generator=generator)
    tracked = torch.rand(100, ROWS - 1, generator=generator) < 0.8
    tracks = torch.cat((tracked.float().unsqueeze(-1), low, high), -1)
    asked, other = shown.clone().requires_grad_(), shown.clone().requires_grad_()
    found, wanted = assumed.boxes(asked, tracks), by_torch_code.narrowed(assumed.boxes(other), low, high, tracked)
    assert torch.equal(found.low, wanted.low)
    assert torch.equal(found.high, wanted.high)
    assert not torch.equal(found.low, near.low)
    weights = torch.randn(2, *found.low.shape, generator=generator)

    def slope(boxes: Boxes, of: Tensor) -> Tensor:
        bounds = torch.stack((boxes.low, boxes.high))
        return torch.autograd.grad((torch.where(bounds.isfinite(), bounds, 0.0) * weights).sum(), of)[0]

    # At a tie torch halves the gradient; no two bounds here are equal.
    torch.testing.assert_close(slope(found, asked), slope(wanted, other), atol=1e-5, rtol=1e-6)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10_000), any_start=st.booleans(), tracked=st.booleans())
def test_one_node_has_the_bits_of_boxes_filter_and_network_one_after_the_other(
    seed: int, any_start: bool, tracked: bool
) -> None:
    policy, (shown, state) = shielded(any_start=any_start), drawn(seed, 200)
    tracks, generator = None, torch.Generator().manual_seed(seed)
    if tracked:
        near = policy.assumed.boxes(shown)
        low, high = (one[:, 1:] + 0.3 * torch.randn(200, ROWS - 1, 4, generator=generator) for one in near[1:])
        tracks = torch.cat((torch.ones(200, ROWS - 1, 1), low, high), -1)
    weights = torch.randn(200, len(FACTS.actions), generator=generator)

    def both(asked: Tensor) -> tuple[Tensor, Tensor]:
        scores = policy.answered(asked, policy.assumed, tracks, state)
        return scores.detach(), torch.autograd.grad((scores * weights).sum(), asked)[0]

    with patch.object(Mask, "scores", autospec=True, side_effect=Mask.scores) as node:
        scores, slope = both(shown.clone().requires_grad_())
        assert node.call_count == 1
    with patch.object(shield, "compiled", return_value=None):
        in_turn, slope_in_turn = both(shown.clone().requires_grad_())
    assert torch.equal(scores, in_turn)
    assert torch.equal(slope, slope_in_turn)
    assert torch.equal(policy.answered(shown, policy.assumed, tracks, state), scores)
    assert bool(slope.any())


def test_one_node_has_the_same_bits_in_every_batch_and_dimension() -> None:
    policy = shielded()
    has_the_same_bits_everywhere(policy.scores, *drawn(1, 120))
    takes_several_dimensions_and_none(policy.scores, *drawn(2, 60))


def test_a_shield_that_weighs_otherwise_is_asked() -> None:
    class Halved(Shielded):
        def weighed(self, observation: Tensor, boxes: Boxes, state: State) -> Tensor:
            return super().weighed(observation, boxes, state) / 2

    usual, (shown, state) = shielded(), drawn(3, 40)
    halved = Halved(Shield(), usual.policy, FACTS)
    assert torch.equal(halved.scores(shown, state), usual.scores(shown, state) / 2)


def test_a_tracked_filter_drives_as_by_torch() -> None:
    drives_as_by_torch(shielded(), drawn(5, 80)[0], by_torch)
