"""A road that bends, straightened: enclosures hold every point, the ego is reckoned as the engine drives it, nobody crashes."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as some
from tensordict import TensorDict
from torch import Tensor

from cavbench.attacks.driving.noise import Noise
from cavbench.core.pair import choose
from cavbench.defenses.driving.shield import Shield, Shielded
from cavbench.defenses.driving.tracker import Tracked, Tracker
from cavbench.driving import Control, ObservationThreat
from cavbench.driving.intervals.bends import CREEPING, REMEMBERED, directions, enclosed, points, projected, slip
from cavbench.driving.intervals.boxes import Boxes
from cavbench.driving.intervals.ego import Step
from cavbench.driving.intervals.policy import reckoning
from cavbench.driving.intervals.rooms import cars_of
from cavbench.driving.intervals.tracks import predicted
from cavbench.driving.rollout import rollout
from cavbench.envs.roads.u_turn_world import UTurnWorld
from cavbench.errors import UserError
from tests.driving.intervals.drivers import FAST, SEEDS, Fastest

WORLD = UTurnWorld()
FACTS = WORLD.facts
CAR = FACTS.kinematics
assert CAR is not None
assert CAR.way is not None
WAY, WIDTH = CAR.way, CAR.lane_width
HALF_CIRCLE, END = 128.0, 128.0 + 20 * math.pi
SLOW = FACTS.actions.index("SLOWER")
STILL = -1e-3
"""Cars drive forwards. One that crashed may roll back, which the tracker does not allow for on any road."""


def located(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Station, offset and direction on highway-env's U-turn: there at y = 44, round (128, 24) to the left, and back at y = 4."""
    angle = torch.atan2(y - 24, x - HALF_CIRCLE)
    bend, there = x > HALF_CIRCLE, y > 24
    station = torch.where(there, x, END + HALF_CIRCLE - x)
    offset, direction = torch.where(there, y - 44, 4 - y), torch.where(there, 0.0, -math.pi)
    return (
        torch.where(bend, HALF_CIRCLE + 20 * (math.pi / 2 - angle), station),
        torch.where(bend, torch.hypot(x - HALF_CIRCLE, y - 24) - 20, offset),
        torch.where(bend, angle - math.pi / 2, direction),
    )


@settings(max_examples=60, deadline=None)
@given(
    station=some.floats(60, 260),
    offset=some.floats(-2, 6),
    wide=some.floats(0, 12),
    high=some.floats(0, 12),
    seed=some.integers(0, 1000),
)
def test_the_enclosure_of_a_rectangle_holds_all_of_its_points_that_are_on_the_road(
    station: float, offset: float, wide: float, high: float, seed: int
) -> None:
    middle = torch.stack(points(WAY, torch.tensor(station), torch.tensor(offset)))
    size = torch.tensor([wide, high])
    share = torch.rand(300, 2, generator=torch.Generator().manual_seed(seed))
    share[:4] = torch.tensor([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]])
    drawn = middle + (share - 0.5) * size
    found = enclosed(WAY, WIDTH, middle - size / 2, middle + size / 2)
    at, beside, _ = located(drawn[:, 0], drawn[:, 1])
    on_road = (beside > -3) & (beside < 7)
    stations = torch.tensor(WAY.stations)
    bounds = [[(stations + found.along[0]), (stations + found.along[1])], found.offset]
    holds = found.valid.expand(len(drawn), -1)
    for value, (least, most) in zip((at, beside), bounds, strict=True):
        holds = holds & (value.unsqueeze(1) >= least - 1e-3) & (value.unsqueeze(1) <= most + 1e-3)
    assert bool((holds.any(1) | ~on_road).all())


@settings(max_examples=60, deadline=None)
@given(low=some.tuples(some.floats(-20, 20), some.floats(-20, 20)), wide=some.floats(0, 3), turn=some.floats(-4, 4))
def test_speeds_along_and_across_hold_those_of_every_velocity_and_direction(
    low: tuple[float, float], wide: float, turn: float
) -> None:
    corner, span = torch.tensor(low), 0.7
    bounds = projected(corner, corner + wide, torch.tensor([turn]), torch.tensor([turn + span]))
    share = torch.rand(400, 3, generator=torch.Generator().manual_seed(0))
    velocity, direction = corner + wide * share[:, :2], turn + span * share[:, 2]
    along = velocity[:, 0] * direction.cos() + velocity[:, 1] * direction.sin()
    across = velocity[:, 1] * direction.cos() - velocity[:, 0] * direction.sin()
    for value, (least, most) in ((along, bounds[:2]), (across, bounds[2:])):
        assert float(value.min()) >= float(least) - 1e-3
        assert float(value.max()) <= float(most) + 1e-3


def test_the_ego_is_reckoned_round_the_half_circle_as_the_engine_drives_it() -> None:
    env = WORLD.build([WORLD.axes.cell(density=0.2)] * len(SEEDS), Control())
    td = env.reset(TensorDict({"seed": torch.tensor(SEEDS)}, batch_size=env.batch_size))
    moves, assumed = reckoning(FACTS, "discrete"), Shielded(Shield(), Fastest(), FACTS).assumed
    state, over = moves.unknown(torch.tensor(SEEDS)), torch.zeros(len(SEEDS), dtype=torch.bool)
    generator = torch.Generator().manual_seed(0)
    for _ in range(230):
        shown = td["observation"]
        boxes = moves.boxes(assumed, shown, state)
        seen = moves.corrected(shown, moves.now(boxes, state), boxes, assumed)
        apart = (FACTS.features.physical(seen) - FACTS.features.physical(shown))[:, 0].abs()
        assert bool((apart[~over] < 0.05).all())
        steady = torch.rand(len(SEEDS), generator=generator) < 0.9
        action = torch.where(steady, 1, torch.randint(5, (len(SEEDS),), generator=generator))
        state = moves.step(boxes, state, action).after
        td = env.step(td.set("action", action))["next"]
        over = over | td["done"].squeeze(-1)
    assert float(state[:, 7].max()) > END


def test_straightened_boxes_and_tracks_hold_the_truth_of_every_car() -> None:
    env = WORLD.build([WORLD.axes.cell(density=2.0)] * len(SEEDS), Control())
    policy = Tracked(Tracker(), Shielded(Shield(), Fastest(), FACTS), FACTS)
    td = env.reset(TensorDict({"seed": torch.tensor(SEEDS)}, batch_size=env.batch_size))
    state, generator = policy.initial(torch.tensor(SEEDS)), torch.Generator().manual_seed(0)
    fitted, rows, bent = 0, 0, 0
    for _ in range(120):
        truth = td["observation"]
        radius = ObservationThreat().radius(truth, FACTS.features)
        shown = (truth + radius * (2 * torch.rand(truth.shape, generator=generator) - 1)).clamp(-1, 1)
        boxes = policy.boxes(shown, state)
        physical = FACTS.features.physical(truth)
        own, others = physical[:, :1], physical[:, 1:] + physical[:, :1]
        station, offset, direction = located(others[..., 0], others[..., 1])
        vx, vy, cos, sin = others[..., 2], others[..., 3], direction.cos(), direction.sin()
        along = vx * cos + vy * sin
        exact = torch.stack([station - located(own[..., 0], own[..., 1])[0], offset, along, vy * cos - vx * sin], -1)
        base = torch.cat([torch.zeros_like(boxes.low[:, :1, :1]), boxes.low[:, :1, 1:]], -1)
        count = exact.shape[1]
        low, high = (side[:, 1 : 1 + count] + base for side in (boxes.low, boxes.high))
        held = ((low - 1e-2 <= exact) & (exact <= high + 1e-2)).all(-1)
        crashed = torch.from_numpy(env.engine.bodies["crashed"]).bool().any(1, keepdim=True)
        here = boxes.present[:, 1 : 1 + count] & (along > STILL) & ~crashed & ~td["done"]
        fitted, rows = fitted + int((held & here).sum()), rows + int(here.sum())
        bent += int((here & (station > HALF_CIRCLE) & (station < END)).sum())
        action = policy.decide(shown, state)
        state = policy.advance(shown, action, state)
        td = env.step(td.set("action", action))["next"]
    assert bent > 300
    # A car that appears beside another one may be taken for it, for one decision.
    assert fitted > 0.999 * rows


@pytest.mark.parametrize("attack", [None, Noise()])
def test_nobody_who_keeps_to_the_assumptions_is_hit_round_the_half_circle(attack: Any) -> None:
    """Behind a single car, which never brakes, a driver that only accelerates does not crash, whatever it is shown."""
    policy = Tracked(Tracker(), Shielded(Shield(), Fastest(), FACTS), FACTS)
    env = WORLD.build([WORLD.axes.cell(density=0.2)] * len(SEEDS), Control())
    threat = ObservationThreat(budget=0.1 if attack else 0.0)
    columns = rollout(env, policy, attack, threat, list(SEEDS), facts=FACTS, attack_seed=0)
    assert not columns["crashed"].any()
    assert (columns["assured"] > (0.6 if attack else 0.95)).all()
    assert (columns["safe_progress"] > 0.4).all()


def alone(state: Tensor) -> Tensor:
    """An observation [1, 10, 5] of the ego of a state [1, 8], and of nobody else."""
    offset, course, speed, *_, station = state[0]
    direction, curvature = directions(WAY, station)
    heading = direction + course - slip(curvature, CAR)
    own = torch.stack([*points(WAY, station, offset), speed * heading.cos(), speed * heading.sin()])
    row = torch.cat([torch.ones(1), FACTS.features.normalised(own)])
    return torch.cat([row.unsqueeze(0), torch.zeros(9, 5)]).unsqueeze(0)


def test_a_car_that_gets_out_of_sight_is_remembered() -> None:
    """From within the half circle highway-env's ego sees nothing beyond its end."""
    policy = Tracked(Tracker(), Shielded(Shield(), Fastest(), FACTS), FACTS)
    low, high = torch.zeros(1, 10, 4), torch.zeros(1, 10, 4)
    low[0, 0] = high[0, 0] = torch.tensor([170.0, 0.0, 16.0, 0.0])
    present = torch.zeros(1, 10, dtype=torch.bool)
    present[0, :2] = True
    # A car at 6 m/s that leaves the half circle ahead.
    low[0, 1], high[0, 1] = torch.tensor([19.0, -0.2, -10.2, -0.2]), torch.tensor([21.0, 0.2, -9.8, 0.2])
    moves = policy.reckoning
    state = torch.tensor([[0.0, 0.0, 16.0, 0.0, 16.0, 1.0, 1.0, 170.0]])
    step = moves.step(Boxes(present, low, high), state, torch.tensor([1]))
    tracks = predicted(Boxes(present, low, high), *step, CAR, policy.period)
    boxes = moves.boxes(policy.assumed, alone(step.after), step.after, tracks)
    assert boxes.present.shape == (1, 10 + REMEMBERED)
    assert boxes.present[0, 10:].sum() == 1
    # It may have braked to walking pace, as long as it would be in the way where the ego sees past the end.
    for _ in range(20):
        step, boxes = one_later(policy, boxes, step.after, torch.tensor([SLOW]))
    assert boxes.present[0, 10:].sum() == 1
    stands, own = float(boxes.low[0, 10, 0] + boxes.low[0, 0, 0]), boxes.low[0, 0, 2]
    assert END < stands < 194
    assert float(boxes.low[0, 10, 2] + own) == pytest.approx(0, abs=1e-4)
    assert float(boxes.high[0, 10, 0] + boxes.low[0, 0, 0]) > 199
    assert float(cars_of(moves.now(boxes, step.after), boxes, CAR).low[0, 9, 0]) < stands - float(step.after[0, 7])
    # Farther on it may have stopped.
    for _ in range(120):
        step, boxes = one_later(policy, boxes, step.after, torch.tensor([SLOW]))
    stands, own = float(boxes.low[0, 10, 0] + boxes.low[0, 0, 0]), boxes.low[0, 0, 2]
    assert END + CAR.length < stands < END + CAR.length + 4
    assert float(boxes.low[0, 10, 2] + own) == pytest.approx(0, abs=1e-4)


def one_later(policy: Tracked, boxes: Boxes, state: Tensor, action: Tensor) -> tuple[Step, Boxes]:
    """The ego and the boxes after an action [1], where nobody is seen."""
    step = policy.reckoning.step(boxes, state, action)
    tracks = predicted(boxes, *step, CAR, policy.period)
    return step, policy.reckoning.boxes(policy.assumed, alone(step.after), step.after, tracks)


def out_of_sight(speed: float) -> tuple[Tracked, Boxes, Tensor]:
    """Boxes of an ego in the half circle that has just lost sight of a car ahead at this speed in m/s, and the ego's state."""
    policy = Tracked(Tracker(), Shielded(Shield(), Fastest(), FACTS), FACTS)
    low, high = torch.zeros(1, 10, 4), torch.zeros(1, 10, 4)
    low[0, 0] = high[0, 0] = torch.tensor([170.0, 0.0, 8.0, 0.0])
    present = torch.zeros(1, 10, dtype=torch.bool)
    present[0, :2] = True
    low[0, 1] = torch.tensor([20.5, -0.2, speed - 8.2, -0.2])
    high[0, 1] = torch.tensor([21.5, 0.2, speed - 7.8, 0.2])
    return policy, Boxes(present, low, high), torch.tensor([[0.0, 0.0, 8.0, 0.0, 8.0, 1.0, 1.0, 170.0]])


def fastest(policy: Tracked, boxes: Boxes, state: Tensor) -> Tensor:
    """FASTER where the shield allows it, else SLOWER, [1]."""
    shield = policy.policy
    assert isinstance(shield, Shielded)
    allowed = shield.allowed(shield.margins(policy.reckoning.now(boxes, state), boxes))
    return torch.where(allowed[:, FAST] > 0.5, FAST, SLOW)


@settings(max_examples=6, deadline=None)
@given(speed=some.floats(1.5, 8), braking=some.floats(0.5, 6), delay=some.integers(0, 30))
@pytest.mark.slow
def test_a_car_out_of_sight_is_not_hit_and_not_waited_for_for_ever(speed: float, braking: float, delay: int) -> None:
    """It brakes at some moment, in the way to walking pace, farther on to a stop; then the ego comes to where it sees it."""
    policy, boxes, state = out_of_sight(speed)
    true, station, dt = speed, 191.0, policy.period
    for moment in range(300):
        step, boxes = one_later(policy, boxes, state, fastest(policy, boxes, state))
        state = step.after
        least = CREEPING if station < END + CAR.length + 3 else 0.0
        slower = max(true - braking * dt, min(least, true)) if moment >= delay else true
        station, true = station + (true + slower) / 2 * dt, slower
        assert station - float(state[0, 7]) > CAR.length, moment
        if float(state[0, 7]) > END:
            break
        rows = boxes.present[0, 10:]
        low, high = (side[0, 10:][rows] + boxes.low[0, 0] for side in (boxes.low, boxes.high))
        here = (low[:, 0] <= station) & (station <= high[:, 0]) & (low[:, 2] <= true) & (true <= high[:, 2])
        assert bool(here.any()), (moment, station, true)
    assert float(state[0, 7]) > END


def test_a_driver_without_intervals_is_shown_the_middles_in_the_frame_of_the_world() -> None:
    policy = Tracked(Tracker(assumed_budget=0.0, assumed_noise=0.0), Fastest(), FACTS)
    env = WORLD.build([WORLD.home] * len(SEEDS), Control())
    td = env.reset(TensorDict({"seed": torch.tensor(SEEDS)}, batch_size=env.batch_size))
    state = policy.initial(torch.tensor(SEEDS))
    for _ in range(60):
        shown = td["observation"]
        passed = policy.passed(shown, state).observation
        near = (FACTS.features.physical(shown)[..., :2].norm(dim=-1) < 40) & (shown[..., 0] > 0) & ~td["done"]
        apart = (FACTS.features.physical(passed) - FACTS.features.physical(shown)).abs()
        assert passed.shape == shown.shape
        assert float(apart[near].median(0).values.max()) < 0.1
        action = torch.full((len(SEEDS),), 1)
        state = policy.advance(shown, action, state)
        td = env.step(td.set("action", action))["next"]


def test_every_shown_value_of_a_car_near_by_has_a_gradient() -> None:
    policy = Tracked(Tracker(), Shielded(Shield(), Fastest(), FACTS), FACTS)
    env = WORLD.build([WORLD.home] * len(SEEDS), Control())
    td = env.reset(TensorDict({"seed": torch.tensor(SEEDS)}, batch_size=env.batch_size))
    state = policy.initial(torch.tensor(SEEDS))
    for _ in range(30):
        action = torch.full((len(SEEDS),), 1)
        state = policy.advance(td["observation"], action, state)
        td = env.step(td.set("action", action))["next"]
    shown = td["observation"].clone().requires_grad_(True)
    (gradient,) = torch.autograd.grad(policy.scores(shown, state)[:, FAST].sum(), shown)
    assert bool(gradient.isfinite().all())
    assert bool((gradient[:, 1:, 1:].abs().amax((1, 2)) > 0).all())


def test_what_needs_straight_lanes_is_refused_in_one_line() -> None:
    with pytest.raises(UserError, match="they bend") as refused:
        reckoning(FACTS, "continuous")
    assert "\n" not in str(refused.value)
    for name in ("pessimist_q", "monitor"):
        with pytest.raises(UserError, match="they bend"):
            choose("defense", name).component.load(choose("victim", "planner").component, 0, FACTS)
