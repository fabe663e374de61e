"""Margins: their gradients, and that no car which keeps to the assumptions is hit."""

from __future__ import annotations

import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from torch import Tensor

from cavbench.driving import ObservationThreat
from cavbench.driving.intervals.boxes import Assumed
from cavbench.driving.intervals.ego import Ego, fields
from cavbench.driving.intervals.kernels import LEVELS_PER_UNIT, REAR_BRAKING, used
from cavbench.driving.intervals.margins import Judge
from cavbench.driving.intervals.policy import reckoning
from cavbench.driving.intervals.rooms import Cars, Caution, cars_of
from tests.driving.intervals.drivers import FACTS, FAST


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_the_gradients_of_rooms_and_speeds_are_those_of_finite_differences(seed: int) -> None:
    count, others = 64, 6
    generator = torch.Generator().manual_seed(seed)
    judge = Judge(reckoning(FACTS, "discrete"), 1 / FACTS.decision_hz, Caution(braking=0.5, seconds=2.0, distance=0.4))
    scale, one = torch.tensor([60.0, 5.0, 8.0, 1.0]), torch.ones(count)
    low = torch.rand(count, others, 4, generator=generator) * scale + torch.tensor([-20.0, 0.0, 15.0, -0.5])
    width = torch.rand(low.shape, generator=generator)
    speed = 20 + 8 * torch.rand(count, generator=generator)
    ego = Ego(y=4 * one, heading=0 * one, speed=speed, target_lane=one, target_speed=speed, edge=2 * one)
    weights = [torch.randn(shape, generator=generator) for shape in ((count, 6, 3, 4), (count, 3, 4), (count, 9))]
    slowing = 5 * torch.rand(count, 4, generator=generator)

    def weighed(low: Tensor, speed: Tensor) -> Tensor:
        """[count] a weighted sum of all rooms and speeds."""
        moving, cars = ego._replace(speed=speed), Cars(torch.ones(count, others, dtype=torch.bool), low, low + width)
        found = (*judge.rooms(moving, cars, speed[:, None].expand(-1, 4), slowing), judge.rooms.speeds(moving, cars))
        return torch.stack([(w * each).flatten(1).sum(1) for w, each in zip(weights, found, strict=True)]).sum(0)

    step, direction = 1e-2, torch.randn(low.shape, generator=generator) * torch.tensor([1.0, 0.0, 1.0, 0.0])
    asked, own = low.clone().requires_grad_(), speed.clone().requires_grad_()
    by_low, by_own = torch.autograd.grad(weighed(asked, own).sum(), (asked, own))
    slope = (by_low * direction).sum((1, 2)) + by_own
    ahead, back = weighed(low + step * direction, speed + step), weighed(low - step * direction, speed - step)
    # Where another car becomes the nearest one within the step, there is no slope.
    assert float(((ahead - back) / (2 * step) - slope).abs().median()) < 0.02 * float(slope.abs().mean())


def test_margins_use_no_room_that_is_not_computed() -> None:
    count, others, generator = 256, 6, torch.Generator().manual_seed(0)
    judge = Judge(reckoning(FACTS, "discrete"), 1 / FACTS.decision_hz, Caution(braking=0.5, seconds=2.0, distance=0.4))
    low = torch.rand(count, others, 4, generator=generator) * torch.tensor([80.0, 8.0, 10.0, 2.0])
    low = low + torch.tensor([-30.0, 0.0, 15.0, -1.0])
    speed, aim = (15 + 15 * torch.rand(count, generator=generator) for _ in range(2))
    off, one = 8 * torch.rand(count, generator=generator), torch.ones(count)
    ego = Ego(y=off, heading=0 * one, speed=speed, target_lane=one, target_speed=aim, edge=2 * one)
    cars = Cars(torch.ones(count, others, dtype=torch.bool), low, low + 1)
    some = judge(ego, cars)
    assert not judge.rooms.asked.all()
    judge.rooms.asked[:] = True
    for name, value in judge(ego, cars)._asdict().items():
        torch.testing.assert_close(getattr(some, name), value, rtol=0, atol=0, msg=name)


@settings(max_examples=4, deadline=None)
@given(seed=st.integers(0, 10_000), rate=st.sampled_from([1.25, 4.0]))
def test_no_leader_that_brakes_as_assumed_is_hit(seed: int, rate: float) -> None:
    """FASTER whenever it is safe, behind leaders that brake at the assumed rate for the assumed time, each at its own moment."""
    moves, period, count = reckoning(FACTS, "discrete"), 1 / FACTS.decision_hz, 256
    judge = Judge(moves, period, Caution(braking=rate, seconds=1.5, distance=0.4))
    assumed, generator = Assumed(FACTS.features, "relative", 0.1), torch.Generator().manual_seed(seed)

    def drawn(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, generator=generator)

    speed, leader, start, one = drawn(12, 30), drawn(17, 30), drawn(0, 60).floor(), torch.ones(count)
    ego = Ego(y=4 * one, heading=0 * one, speed=speed, target_lane=one, target_speed=speed, edge=2 * one)
    following = judge.rooms.following
    table, pairs = following.tables[0], zip(speed.tolist(), leader.tolist(), strict=True)
    needed = [used(table, following.side, own, other, int(rate * LEVELS_PER_UNIT))[0] for own, other in pairs]
    gap = 6.0 + torch.tensor(needed) + drawn(0, 20)
    half, once = FACTS.features.half_range(), torch.zeros(count, dtype=torch.bool)
    for step in range(120):
        truth = torch.zeros(count, 2, 5)
        truth[:, :, 0] = 1.0
        truth[:, 0, 1:] = torch.stack([100 * one, 4 * one, ego.speed, 0 * one], -1) / half
        truth[:, 1, 1:] = torch.stack([gap, 0 * one, leader - ego.speed, 0 * one], -1) / half
        radius = ObservationThreat().radius(truth, FACTS.features)
        shown = (truth + radius * (2 * torch.randint(0, 2, truth.shape, generator=generator) - 1)).clamp(-1, 1)
        stay = judge(ego, cars_of(ego, assumed.boxes(shown))).stay
        once |= (stay >= 0).any(-1)
        gap = gap + (leader - ego.speed) * period
        leader = leader - rate * period * ((start <= step) & (step < start + 22))
        after = moves.after(ego, torch.where(stay[:, 0] >= 0, FAST, FACTS.actions.index("SLOWER")))
        ego = fields(after)[0]
        assert bool((gap > 5.0)[once].all())
    assert once.float().mean() > 0.5


@settings(max_examples=40, deadline=None)
@given(
    speed=st.sampled_from([15.0, 18.0, 20.0, 23.0, 25.0, 30.0]),
    closing=st.floats(-6, 4),
    aim=st.sampled_from([-10.0, -5.0, 0.0, 5.0]),
    ahead=st.sampled_from([5.6, 8.0, 15.0, 60.0]),
)
def test_no_car_behind_is_hit_after_a_lane_change_into_the_least_room(
    speed: float, closing: float, aim: float, ahead: float
) -> None:
    """Of the safe actions the slowest is taken each time; the car behind brakes as soon as the ego has moved a metre.

    A car ahead on the lane that is left, as fast as the ego, tempts it to brake.
    """
    moves, period, one = reckoning(FACTS, "discrete"), 1 / FACTS.decision_hz, torch.ones(1)
    judge = Judge(moves, period, Caution(braking=0.5, seconds=2.0, distance=0.4))
    low, high = moves.kinematics.target_speeds[0], moves.kinematics.target_speeds[-1]
    target = min(max(round((speed + aim) / 5) * 5.0, low), high) * one
    ego = Ego(y=0 * one, heading=0 * one, speed=speed * one, target_lane=0 * one, target_speed=target, edge=one)
    behind, lead = speed + closing, speed

    def cars(gap: float, front: float) -> Cars:
        both = torch.tensor([[[-gap, 4.0, behind, 0.0], [front, 0.0, lead, 0.0]]])
        return Cars(torch.ones(1, 2, dtype=torch.bool), both, both)

    room = float(judge(ego, cars(100, ahead)).change[0, 1])
    gap = 100 - float(judge(ego, cars(100, 200)).change[0, 1])
    assume(room >= 0)
    action = FACTS.actions.index("LANE_RIGHT")
    for _ in range(40):
        gap, ahead = gap + (float(ego.speed) - behind) * period, ahead + (lead - float(ego.speed)) * period
        behind = max(behind - REAR_BRAKING * period * (float(ego.y) > 1), 0.0)
        after = moves.after(ego, torch.tensor([action]))
        ego = fields(after)[0]
        assert gap > 5.0
        margins = judge(ego, cars(gap, ahead))
        safe = (margins.stay[0] >= 0).nonzero().flatten().tolist()
        chosen = safe[-1] if safe else int(margins.most[0].int().argmax())
        action = FACTS.actions.index(("FASTER", "IDLE", "SLOWER")[chosen])


@pytest.mark.parametrize("other", [0.0, 4.0])
def test_a_lane_that_may_not_exist_is_tried_only_where_idling_is_safe(other: float) -> None:
    """LANE_RIGHT is in vain on the rightmost lane. A car further to the right shows that there is a lane."""
    moves, one = reckoning(FACTS, "discrete"), torch.ones(1)
    judge = Judge(moves, 1 / FACTS.decision_hz, Caution(braking=0.5, seconds=2.0, distance=0.4))
    ego = Ego(y=0 * one, heading=0 * one, speed=28 * one, target_lane=0 * one, target_speed=25 * one, edge=64 * one)
    cars = torch.tensor([[[10.0, 0.0, 20.0, 0.0], [90.0, other, 25.0, 0.0]]])
    margins = judge(ego, Cars(torch.ones(1, 2, dtype=torch.bool), cars, cars))
    assert float(margins.stay[0, 1]) < 0
    assert (float(margins.change[0, 1]) >= 0) == (other > 0)


@pytest.mark.parametrize("free", [True, False])
def test_a_way_out_leads_past_a_leader_that_is_slower_than_the_ego_can_be(free: bool) -> None:
    """Close behind it even a lane change is not safe; it is taken where the lane beside has room, and not counted as safe."""
    moves, one = reckoning(FACTS, "discrete"), torch.ones(1)
    judge = Judge(moves, 1 / FACTS.decision_hz, Caution(braking=0.5, seconds=2.0, distance=0.4))
    slowest = moves.kinematics.target_speeds[0]
    ego = Ego(
        y=0 * one, heading=0 * one, speed=slowest * one, target_lane=0 * one, target_speed=slowest * one, edge=one
    )
    ahead, beside = [5.3, 0.0, slowest - 2, 0.0], [80.0 if free else 8.0, 4.0, slowest, 0.0]
    cars = torch.tensor([[ahead, beside]])
    margins = judge(ego, Cars(torch.ones(1, 2, dtype=torch.bool), cars, cars))
    assert float(margins.change.amax()) < 0
    assert not bool(margins.safe)
    assert bool((margins.worth_changing >= 0)[0, 1]) == free
    assert not bool((margins.worth_changing >= 0)[0, 0])
