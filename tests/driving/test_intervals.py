"""Intervals hold the truth, dead reckoning is exact, and a shielded driver hits no car that keeps to the assumptions."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor

from cavbench.attacks.driving.noise import Noise
from cavbench.attacks.driving.pgd import PGD
from cavbench.core.pair import choose
from cavbench.defenses.driving.shield import Shield, Shielded, ShieldedControls
from cavbench.defenses.driving.tracker import Tracked, Tracker
from cavbench.driving import DrivingVictim, ObservationThreat, Policy
from cavbench.driving.intervals.boxes import Assumed
from cavbench.driving.intervals.ego import Ego
from cavbench.driving.intervals.kernels import LEVELS_PER_UNIT, REAR_BRAKING, used
from cavbench.driving.intervals.margins import Judge
from cavbench.driving.intervals.policy import reckoning
from cavbench.driving.intervals.rooms import Cars, Caution, cars_of
from cavbench.driving.rollout import rollout
from cavbench.driving.threat import Norm
from cavbench.driving.victims.planner import IntervalPlanner, Planner
from cavbench.envs.highway.axes import AXES
from cavbench.envs.highway.batched import BatchedHighway
from cavbench.envs.highway.world import HighwayWorld
from cavbench.errors import UserError
from cavbench.scenarios import SeedBlock
from tests.attacks.driving.victims import observations
from tests.plugins.toy import ToyWorld

WORLD = HighwayWorld()
FACTS = WORLD.facts
FAST = FACTS.actions.index("FASTER")
SEEDS = range(SeedBlock.TRAIN, SeedBlock.TRAIN + 6)


class Fastest(Policy):
    """Always FASTER, with a gradient, so that only the filter keeps it from crashing."""

    action_type = "discrete"

    def forward(self, observation: Tensor) -> Tensor:
        wanted = torch.eye(len(FACTS.actions))[FAST]
        return wanted + 1e-3 * observation.flatten(-2).sum(-1, keepdim=True)


class Pushing(Policy):
    """Always the same controls, with a gradient, so that only the filter keeps it from crashing."""

    action_type = "continuous"

    def __init__(self, acceleration: float, steering: float) -> None:
        super().__init__()
        self.controls = torch.tensor([acceleration, steering])

    def forward(self, observation: Tensor) -> Tensor:
        return self.controls + 1e-3 * observation.flatten(-2).sum(-1, keepdim=True)


def roads(world: HighwayWorld, episodes: int = len(SEEDS), **values: Any) -> BatchedHighway:
    cell = world.axes.cell(**{"lanes": 3, "density": 1.0, "weather": "clear"} | values)
    return world.make([cell] * episodes)  # type: ignore[return-value]


def driven(world: HighwayWorld, policy: Policy, attack: Any, **values: Any) -> dict[str, Any]:
    threat = ObservationThreat(budget=0.1 if attack else 0.0)
    cell = world.axes.cell(**{"lanes": 3, "density": 1.0, "weather": "clear"} | values)
    env = world.make([cell] * len(SEEDS), action_type=policy.action_type)
    return rollout(env, policy, attack, threat, list(SEEDS), facts=world.facts, attack_seed=0)


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


def test_dead_reckoning_is_exact_whatever_is_shown() -> None:
    env = roads(WORLD, lanes=4)
    moves, generator = reckoning(FACTS, "discrete"), torch.Generator().manual_seed(0)
    assumed = Assumed(FACTS.features, "relative", 0.1)
    td = env.reset(TensorDict({"seed": torch.tensor(SEEDS)}, batch_size=env.batch_size))
    state = moves.unknown(torch.tensor(SEEDS))
    compared = 0
    for step in range(90):
        truth, running = td["observation"], ~td["done"].squeeze(-1)
        radius = ObservationThreat().radius(truth, FACTS.features)
        shown = truth + radius * (2 * torch.rand(truth.shape, generator=generator) - 1)
        ego = moves.now(assumed.boxes(shown), state)
        on_road = running & (ego.edge < 64) if step > 60 else running & (ego.target_lane < 4)
        cars = env.engine.vehicles[:, 0]
        y = torch.from_numpy(cars["y"].copy())[on_road]
        torch.testing.assert_close(ego.y[on_road].double(), y, atol=2e-3, rtol=0)
        speed = torch.from_numpy(cars["speed"].copy())[on_road]
        torch.testing.assert_close(ego.speed[on_road].double(), speed, atol=2e-3, rtol=0)
        compared += int(on_road.sum())
        # Every lane in turn to the left, FASTER and SLOWER in random order; LANE_LEFT stays on the road.
        action = torch.tensor([0, 1, 3, 4])[torch.randint(0, 4, (len(SEEDS),), generator=generator)]
        td = env.step(td.set("action", action))["next"]
        state = moves.after(ego, action)
    assert compared > 200


def test_a_lane_that_does_not_exist_is_noticed() -> None:
    env = roads(WORLD, lanes=3)
    moves, assumed = reckoning(FACTS, "discrete"), Assumed(FACTS.features, "relative", 0.1)
    td = env.reset(TensorDict({"seed": torch.tensor(SEEDS)}, batch_size=env.batch_size))
    state = moves.unknown(torch.tensor(SEEDS))
    found = torch.zeros(len(SEEDS), dtype=torch.bool)
    for _ in range(75):
        ego = moves.now(assumed.boxes(td["observation"]), state)
        action = torch.full((len(SEEDS),), 2)
        td = env.step(td.set("action", action))["next"]
        state = moves.after(ego, action)
        found |= ~td["done"].squeeze(-1) & (ego.edge == 2)
    assert bool(found.any())


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
        ego = Ego(*(after[name] for name in Ego._fields))
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
        ego = Ego(*(after[name] for name in Ego._fields))
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


@pytest.mark.parametrize("attack", [None, Noise(), PGD(objective="target", target_action=FAST, steps=3, restarts=1)])
def test_the_shield_holds_the_guarantee_in_the_engine(attack: Any) -> None:
    """Behind a single car, which never brakes, a driver that only accelerates does not crash, whatever it is shown."""
    world = HighwayWorld(vehicles=1, max_steps=120)
    policy = Shielded(Shield(), Fastest(), world.facts)
    columns = driven(world, policy, attack, lanes=2)
    assert not columns["crashed"].any()
    assert (columns["assured"] > (0.6 if attack else 0.98)).all()
    assert (columns["mean_speed"] > 20).all()


@pytest.mark.parametrize("steering", [0.0, 1.0])
@pytest.mark.parametrize("attack", [None, Noise(), PGD(objective="target", steps=3, restarts=1)])
def test_the_shield_of_continuous_controls_holds_the_guarantee_in_the_engine(attack: Any, steering: float) -> None:
    """Behind a single car, at full throttle and full lock: neither a crash nor a way off the road."""
    world = HighwayWorld(vehicles=1, max_steps=120)
    policy = ShieldedControls(Shield(), Pushing(1.0, steering), world.facts)
    columns = driven(world, policy, attack, lanes=2)
    assert not columns["crashed"].any()
    assert not columns["offroad"].any()
    # At the least distance that is safe, noise decides from frame to frame.
    assert (columns["assured"] > (0.4 if attack else 0.98)).all()
    assert (columns["mean_speed"] > 20).all()


def test_continuous_actions_are_projected_onto_what_passes() -> None:
    env = HighwayWorld().make([AXES.cell(lanes=3, density=1.0)] * len(SEEDS), action_type="continuous")
    td = env.reset(TensorDict({"seed": torch.tensor(SEEDS)}, batch_size=env.batch_size))
    policy = Tracked(Tracker(), ShieldedControls(Shield(), Pushing(0.3, -0.6), FACTS), FACTS)
    state = policy.initial(torch.tensor(SEEDS))
    clipped = 0
    for _ in range(60):
        shown = td["observation"].clone().requires_grad_(True)
        action, passed = policy.decide(shown, state), policy.passed(shown, state)
        wanted, allowed = policy.policy.policy.scores(passed.observation), passed.allowed
        assert allowed is not None
        expected = wanted.clamp(allowed[:, 0], allowed[:, 1])
        torch.testing.assert_close(action, expected)
        clipped += int((expected != wanted).sum())
        (gradient,) = torch.autograd.grad(action.sum(), shown)
        assert bool(gradient.isfinite().all())
        assert bool((gradient.abs().amax((1, 2)) > 0).all())
        state = policy.advance(shown.detach(), action.detach(), state)
        td = env.step(td.set("action", action.detach()))["next"]
    assert clipped > 60


def test_only_allowed_actions_win() -> None:
    env = roads(WORLD)
    td = env.reset(TensorDict({"seed": torch.tensor(SEEDS)}, batch_size=env.batch_size))
    policy = Tracked(Tracker(), Shielded(Shield(), Fastest(), FACTS), FACTS)
    state = policy.initial(torch.tensor(SEEDS))
    masked = 0
    for _ in range(60):
        action, passed = policy.decide(td["observation"], state), policy.passed(td["observation"], state)
        assert passed.allowed is not None
        assert bool(passed.allowed.gather(1, action.unsqueeze(1)).all())
        masked += int((~passed.allowed[:, FAST]).sum())
        state = policy.advance(td["observation"], action, state)
        td = env.step(td.set("action", action))["next"]
    assert masked > 0


def test_only_the_filter_keeps_that_driver_from_crashing() -> None:
    world = HighwayWorld(max_steps=120)
    bare = driven(world, Fastest(), None)
    shielded = driven(world, Shielded(Shield(), Fastest(), world.facts), None)
    assert bare["crashed"].mean() > 0.5
    assert shielded["crashed"].mean() <= 0.17


def test_the_gradient_passes_the_filter_and_reaches_the_victim() -> None:
    policy = Shielded(Shield(), Fastest(), FACTS)
    env = roads(WORLD)
    td = env.reset(TensorDict({"seed": torch.tensor(SEEDS)}, batch_size=env.batch_size))
    shown = td["observation"].clone().requires_grad_(True)
    scores = policy.scores(shown, policy.initial(torch.tensor(SEEDS)))
    (gradient,) = torch.autograd.grad(scores[:, FAST].sum(), shown)
    assert bool(gradient.isfinite().all())
    assert bool((gradient[:, 1:, 1:].abs().amax((1, 2)) > 0).all())


def test_the_tracker_narrows_boxes_and_keeps_the_truth() -> None:
    env = roads(WORLD, lanes=4)
    policy = Tracked(Tracker(), IntervalPlanner(Planner(), FACTS), FACTS)
    td = env.reset(TensorDict({"seed": torch.tensor(SEEDS)}, batch_size=env.batch_size))
    state = policy.initial(torch.tensor(SEEDS))
    generator, half = torch.Generator().manual_seed(0), FACTS.features.half_range()
    held = narrower = rows = 0
    for _ in range(60):
        truth = td["observation"]
        radius = ObservationThreat().radius(truth, FACTS.features)
        shown = (truth + radius * (2 * torch.rand(truth.shape, generator=generator) - 1)).clamp(-1, 1)
        plain, boxes = policy.assumed.boxes(shown), policy.boxes(shown, state)
        physical = (truth[..., 1:] * half)[:, 1:]
        inside = ((boxes.low[:, 1:] - 1e-2 <= physical) & (physical <= boxes.high[:, 1:] + 1e-2)).all(-1)
        present = boxes.present[:, 1:] & ~td["done"]
        present &= plain.high[:, 1:, 0].isfinite()
        held, rows = held + int((inside & present).sum()), rows + int(present.sum())
        width, before = boxes.high[:, 1:, 0] - boxes.low[:, 1:, 0], plain.high[:, 1:, 0] - plain.low[:, 1:, 0]
        narrower += int(((width < before - 0.01) & present).sum())
        action = policy.decide(shown, state)
        state = policy.advance(shown, action, state)
        td = env.step(td.set("action", action))["next"]
    assert held == rows
    assert narrower / rows > 0.5


def test_the_planner_drives() -> None:
    world = HighwayWorld(max_steps=120)
    columns = driven(world, Planner().load(0, world.facts), None)
    assert not columns["crashed"].any()
    assert columns["safe_progress"].mean() > 0.6
    assert (columns["assured"] > 0.9).all()


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Planner().load(0, ToyWorld().facts), "kinematics"),
        (lambda: Tracker().load(Planner(), 0, ToyWorld().facts), "kinematics"),
        (lambda: Shield().load(blind(), 0, FACTS), "sees"),
    ],
)
def test_what_intervals_cannot_serve_is_refused_in_one_line(make: Any, said: str) -> None:
    with pytest.raises(UserError, match=said) as refused:
        make()
    assert "\n" not in str(refused.value)


def blind() -> DrivingVictim:
    return choose("victim", "blind", policy="faster").component
