"""The driver follows what is detected, confirms what holds together, and believes the width of a box."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from cavbench.detection import stopping
from cavbench.detection.boxes import overlap
from cavbench.detection.closed_loop import Drive, drive
from cavbench.detection.driver import SAME_IOU, Memory
from cavbench.envs.camera.crossing import StopSignCrossing
from cavbench.envs.camera.environment import ApproachEnv
from tests.detection.growing_signs import SIGN_PX_M, GrowingScenes, SquareDetector

DISTANCES = torch.arange(30.0, 7.9, -0.5)
NEVER, ALWAYS = torch.zeros(len(DISTANCES)), torch.ones(len(DISTANCES))


def box(x: float, y: float, width: float) -> Tensor:
    return torch.tensor([x, y, x + width, y + width], dtype=torch.float32)


def boxes(*found: Tensor) -> Tensor:
    return torch.stack(found) if found else torch.zeros(0, 4)


def driven(seen: Tensor, other: Tensor, beyond_m: float) -> Drive:
    return drive(SquareDetector(), ApproachEnv([GrowingScenes(DISTANCES, seen, other, beyond_m)]))


def test_three_detections_at_one_place_confirm_and_three_at_three_places_do_not() -> None:
    still = moving = Memory(SIGN_PX_M)
    for frame in range(5):
        still = still.seeing(boxes(box(50, 20, 16)), frame, 0.5 * frame)
        moving = moving.seeing(boxes(box(50 + 30 * frame, 20, 16)), frame, 0.5 * frame)
        assert bool(still.confirmed) == (frame >= 2)
        assert not moving.confirmed


def test_two_signs_are_two_tracks_and_a_box_continues_one_of_them() -> None:
    memory = Memory(SIGN_PX_M)
    for frame in range(3):
        memory = memory.seeing(boxes(box(50, 20, 16), box(56, 20, 16)), frame, 0.0)
    assert len(memory.tracks) == len(memory.confirmed) == 2
    assert [float(track.box[0]) for track in memory.tracks] == [50, 56]


@given(gaps=st.lists(st.booleans(), min_size=12, max_size=12))
def test_a_track_is_confirmed_by_three_of_five_frames_and_lost_after_five(gaps: list[bool]) -> None:
    memory, confirmed = Memory(SIGN_PX_M), False
    for frame, seen in enumerate(gaps):
        memory = memory.seeing(boxes(box(50, 20, 16)) if seen else boxes(), frame, 0.0)
        confirmed |= sum(gaps[max(0, frame - 4) : frame + 1]) >= 3
        assert bool(memory.confirmed) == confirmed
        alive = [track for track in memory.tracks if track.detected]
        assert bool(alive) == any(gaps[max(0, frame - 4) : frame + 1])


@pytest.mark.parametrize("speed", [8.0, 12.0])
def test_on_the_road_a_sign_is_the_same_place_even_after_two_missed_frames(speed: float) -> None:
    """What the threshold must bridge: the true boxes of the sign, three frames apart."""
    cell = StopSignCrossing.axes.cell(weather="clear", speed=speed)
    scenes = StopSignCrossing().approaches(cell, range(1))[0].scenes
    near = scenes.boxes[scenes.distance <= 31]
    assert float(overlap(near[3:], near[:-3]).min()) >= SAME_IOU


def test_the_driver_believes_the_width_of_the_box() -> None:
    """It divides the width of a sign by that of the box; a box that is half as wide is twice as far away."""
    for share in (0.5, 1.0, 1.25):
        memory = Memory(SIGN_PX_M)
        for frame, distance in enumerate((12.0, 11.5, 11.0)):
            memory = memory.seeing(boxes(box(50, 20, share * SIGN_PX_M / distance)), frame, 12 - distance)
        assert memory.confirmed[0].line_m == pytest.approx(0.5 + 11.5 / share, abs=1e-3)


@settings(deadline=None, max_examples=10)
@given(beyond=st.floats(-12, 12))
def test_something_that_looks_like_a_sign_stops_the_car_where_it_stands(beyond: float) -> None:
    """The sign is hidden: the car stops at the line of what it sees, and the record says how far that is from the true one."""
    one = driven(NEVER, ALWAYS, beyond)
    assert one.false_m > 25
    assert not one.confirmed_m
    assert one.stands
    assert one.short_m - one.overrun_m == pytest.approx(-beyond, abs=0.4)
    assert one.stopped == (-stopping.RAN_M <= one.moments[-1].distance_m <= stopping.EARLY_M)


def test_of_two_signs_the_nearer_one_counts() -> None:
    early, late = driven(ALWAYS, ALWAYS, -10.0), driven(ALWAYS, ALWAYS, 10.0)
    assert early.short_m == pytest.approx(10.0, abs=0.4)
    assert not early.stopped
    assert early.confirmed_m
    assert late.stopped
    assert late.false_m


def test_a_flash_of_a_false_sign_does_not_stop_the_car() -> None:
    other = NEVER.clone()
    other[10:12] = 1
    one = driven(ALWAYS, other, -5.0)
    assert one.stopped
    assert one.short_m < 0.3
    assert not one.false_m


def test_before_it_is_confirmed_and_reacted_to_nothing_is_asked_for() -> None:
    one = driven(ALWAYS, NEVER, 0.0)
    first = next(number for number, moment in enumerate(one.moments) if moment.confirmed)
    braking = next(number for number, moment in enumerate(one.moments) if moment.asked)
    assert (braking - first) * one.step_s >= stopping.REACTION_S - 1e-6
