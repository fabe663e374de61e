"""Cross traffic follows from its seed, and brakes for a car that takes its way."""

from __future__ import annotations

import math

import pytest
import torch

from cavbench.detection.closed_loop import drive
from cavbench.detection.stopping import GREATEST_DECELERATION, REACTION_S
from cavbench.envs.camera.braking import BUILD_UP_S, Brakes, Motion
from cavbench.envs.camera.cross_traffic import LEAST_HEADWAY_S, SPEED_MPS, STANDSTILL_M, CrossTraffic
from cavbench.envs.camera.environment import CAR_M, ApproachEnv
from cavbench.envs.camera.street.layout import CROSSING
from tests.detection.growing_signs import GrowingScenes, SquareDetector


def test_cross_traffic_follows_from_its_seed_and_keeps_its_headway() -> None:
    first, again = (CrossTraffic.drawn([3, 4]) for _ in range(2))
    assert torch.equal(first.motion.distance, again.motion.distance)
    assert not torch.equal(first.motion.distance[0, 0], first.motion.distance[0, 1])
    by_lane = first.motion.distance.view(2, 2, -1) / SPEED_MPS
    assert float(by_lane.diff().min()) >= LEAST_HEADWAY_S - 1e-4
    rectangles = first.rectangles()[0]
    assert (rectangles[..., 1] > CROSSING[0]).all()
    assert (rectangles[..., 3] < CROSSING[1]).all()


def met(car: Motion, seconds: float, reaction_s: float = REACTION_S, seeds: range = range(200)) -> CrossTraffic:
    """The traffic after some time in which the car drives on at its speed."""
    traffic, brakes, tick = CrossTraffic.drawn(seeds), Brakes(), 0.02
    for _ in range(round(seconds / tick)):
        traffic = traffic.moved(car, CAR_M, brakes, reaction_s, tick)
        car = Motion(car.distance - car.speed * tick, car.speed, car.braking)
    return traffic


def car_at(distance: float, speed: float) -> Motion:
    return Motion(torch.tensor([distance]), torch.tensor([speed]), torch.zeros(1))


def test_nobody_brakes_for_a_car_that_can_still_stop_or_has_left() -> None:
    for car in (car_at(20.0, 0.0), car_at(-30.0, 10.0)):
        traffic = met(car, 4.0)
        assert not traffic.braked.any()
        assert float(traffic.motion.speed.min()) == pytest.approx(SPEED_MPS)


def test_traffic_that_does_not_react_drives_on() -> None:
    traffic = met(car_at(0.0, 10.0), 3.0, reaction_s=math.inf)
    assert not traffic.braked.any()


def test_for_a_car_that_stands_across_both_lanes_everybody_stops_who_can() -> None:
    """Who is farther away than mechanics needs, v t + v^2 / 2a + v T / 2 and the gap, stands before the way of the car."""
    before = CrossTraffic.drawn(range(200))
    after = met(car_at(-CROSSING[1] + 1.0, 0.0), 12.0)
    front = before.motion.distance - before.half[..., 0] - CAR_M[1] / 2
    needs = SPEED_MPS * (REACTION_S + BUILD_UP_S / 2) + SPEED_MPS**2 / (2 * GREATEST_DECELERATION) + STANDSTILL_M
    can = (front > needs) & (front < needs + 60)
    gap = (after.motion.distance - after.half[..., 0] - CAR_M[1] / 2)[can]
    assert can.sum() > 100
    assert float(gap.min()) > 0
    assert float(after.motion.speed[can].max()) < 0.01


def test_no_vehicle_drives_into_the_one_before_it() -> None:
    for seconds in (2.0, 4.0, 8.0):
        traffic = met(car_at(-CROSSING[1] + 1.0, 0.0), seconds)
        by_lane = traffic.motion.distance.view(1, 200, 2, -1)
        half = traffic.half[..., 0].view(1, 200, 2, -1)
        between = by_lane.diff() - half[..., 1:] - half[..., :-1]
        assert traffic.braked.any()
        assert float(between.min()) > 0


def test_who_leaves_the_way_before_the_car_arrives_does_not_brake() -> None:
    traffic = CrossTraffic.drawn(range(500))
    car = car_at(2.0, 10.0)
    arrives = (car.distance + CROSSING[0]) / car.speed
    later = traffic.moved(car, CAR_M, Brakes(), REACTION_S, 0.01)
    leaves = (traffic.motion.distance + traffic.half[..., 0] + CAR_M[1] / 2) / SPEED_MPS
    near = traffic.y < sum(CROSSING) / 2
    aware = later.aware_s > 0
    assert not aware[(leaves < arrives) & near].any()
    ahead = traffic.motion.distance - traffic.half[..., 0] > CAR_M[1] / 2
    assert aware[(leaves > arrives) & near & ahead].all()


def test_fewer_cars_collide_with_traffic_that_reacts() -> None:
    def collisions(reaction_s: float) -> float:
        scenes = GrowingScenes(torch.arange(30.0, 7.9, -0.5), torch.zeros(45))
        env = ApproachEnv([scenes], seeds=range(300), reaction_s=reaction_s)
        return float(drive(SquareDetector(), env).collided.mean())

    attentive, blind = (collisions(seconds) for seconds in (REACTION_S, math.inf))
    assert 0 < attentive < 0.9 * blind
