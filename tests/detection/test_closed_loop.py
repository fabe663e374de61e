"""The closed loop: the way to stand, the memory of the driver, and the chain from patch to collision."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from cavbench.detection import stopping
from cavbench.detection.boxes import overlap
from cavbench.detection.closed_loop import Drive, drive, measured
from cavbench.envs.camera.braking import Brakes, brakes_in
from cavbench.envs.camera.cross_traffic import SPEED_MPS, CrossTraffic
from cavbench.envs.camera.environment import CAR_M, ApproachEnv
from cavbench.envs.camera.street.layout import CROSSING
from cavbench.envs.weather import WEATHERS
from tests.detection.growing_signs import GrowingScenes, SquareDetector

DISTANCES = torch.arange(30.0, 7.9, -0.5)
CYAN = torch.tensor([0.0, 1.0, 1.0])[:, None, None].expand(1, 3, 8, 8)
AT_ONCE = Brakes(jerk=math.inf)
SEEN = st.lists(st.booleans(), min_size=len(DISTANCES), max_size=len(DISTANCES))


def driven(seen: list[bool], speed: float = stopping.SPEED_MPS, brakes: Brakes = Brakes()) -> Drive:  # noqa: B008
    """The drive of a car whose detector sees the sign in these frames only."""
    scenes = GrowingScenes(DISTANCES, torch.tensor(seen))
    return drive(SquareDetector(), ApproachEnv([scenes], speed=speed, brakes=brakes))


@settings(deadline=None, max_examples=10)
@given(seen=SEEN)
def test_with_brakes_that_act_at_once_it_agrees_with_the_open_loop(seen: list[bool]) -> None:
    distance, one = DISTANCES.double().numpy()[None], driven(seen, brakes=AT_ONCE)
    confirmed = stopping.first(stopping.confirmed(np.array([seen])), distance)
    assert one.confirmed_m == pytest.approx(confirmed[0], abs=1e-3)
    assert one.stopped != stopping.ran(confirmed)[0]
    if one.confirmed_m:
        assert one.overrun_m == pytest.approx(stopping.overrun_m(confirmed)[0], abs=0.03)
    else:
        assert one.overrun_m > CROSSING[1]


@settings(deadline=None, max_examples=10)
@given(seen=SEEN, speed=st.floats(4, 14), weather=st.sampled_from(["clear", "rain"]))
def test_no_car_stops_in_a_shorter_distance_than_its_brakes_allow(seen: list[bool], speed: float, weather: str) -> None:
    brakes = brakes_in(WEATHERS[weather])
    one = driven(seen, brakes=brakes, speed=speed)
    if one.confirmed_m and one.stands:
        rest = one.confirmed_m - one.moments[-1].distance_m
        assert rest >= speed * stopping.REACTION_S + speed**2 / (2 * brakes.greatest) - 0.02
        assert one.stopped == (one.overrun_m <= stopping.RAN_M)


def test_a_confirmed_sign_is_not_forgotten() -> None:
    one = driven([number < 3 for number in range(len(DISTANCES))])
    assert one.confirmed_m == pytest.approx(29.0, abs=1e-3)
    assert one.stopped
    assert abs(one.moments[-1].distance_m) < 0.3, "it stops at the line, not somewhere before it"


def test_a_frame_that_is_shown_twice_counts_once() -> None:
    slow = driven([True] * len(DISTANCES), speed=4.0)
    assert slow.moments[2].frame < 2
    assert slow.confirmed_m <= float(DISTANCES[2]) + 0.26


RECTANGLES = st.tuples(*[st.integers(-8, 8)] * 2, *[st.integers(1, 6)] * 2).map(
    lambda one: torch.tensor([one[0], one[1], one[0] + one[2], one[1] + one[3]]).double()
)


@given(a=RECTANGLES, b=RECTANGLES)
def test_the_collision_test_is_symmetric_and_that_of_shared_area(a: Tensor, b: Tensor) -> None:
    assert bool(overlap(a, b) > 0) == bool(overlap(b, a) > 0)
    cells = [
        {(x, y) for x in range(int(one[0]), int(one[2])) for y in range(int(one[1]), int(one[3]))} for one in (a, b)
    ]
    assert bool(overlap(a, b) > 0) == bool(cells[0] & cells[1])
    assert bool(overlap(a, a) > 0)


def test_a_patch_that_hides_the_sign_sends_the_car_into_the_crossing() -> None:
    scenes, seeds = GrowingScenes(DISTANCES), range(200)
    clean, patched = (
        drive(SquareDetector(), ApproachEnv([scenes], patch, 0.75, seeds=seeds)) for patch in (None, CYAN)
    )
    assert clean.stopped
    assert not clean.collided.any()
    assert not patched.confirmed_m
    assert not patched.stopped
    assert patched.overrun_m > CROSSING[1] + CAR_M[0]
    columns = measured(patched, len(seeds))
    assert 0.05 < columns["collided"].mean() < 0.8
    assert not columns["stopped"].any()


def test_a_car_is_hit_if_and_only_if_its_path_and_that_of_a_vehicle_meet() -> None:
    """Computed again from the paths: while the car is in a lane, does a vehicle of that lane pass its width?"""
    seeds = range(100)
    patched = drive(
        SquareDetector(), ApproachEnv([GrowingScenes(DISTANCES)], CYAN, 0.75, seeds=seeds, reaction_s=math.inf)
    )
    traffic = CrossTraffic.drawn(seeds)
    half, first_m = traffic.half, float(DISTANCES[0])
    enters = (first_m + traffic.y - half[..., 1]) / stopping.SPEED_MPS
    leaves = (first_m + traffic.y + half[..., 1] + CAR_M[0]) / stopping.SPEED_MPS
    passes, reach = traffic.motion.distance[0] / SPEED_MPS, (half[..., 0] + CAR_M[1] / 2) / SPEED_MPS
    meets = ((passes + reach > enters) & (passes - reach < leaves)).any(1)
    # The loop looks every hundredth of a second.
    assert (torch.from_numpy(patched.collided) != meets).float().mean() <= 0.02
