"""Frames and starts: places between the recorded ones, and starts that another driver really had."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from cavbench.envs.recorded.commonroad import recording
from cavbench.envs.recorded.frames import Stage, stage
from cavbench.formats import markup
from tests.envs.recorded.scenes import Car, Road, platoon, scene, wave, with_static

ROAD = Road()


def staged(cars: Sequence[Car] | None = None, *, hz: int = 15, seconds: float = 6.0, change: float = 3.0) -> Stage:
    return stage(recording(markup.parsed(scene(ROAD, cars).encode()), "scene"), hz, seconds, change)


@pytest.mark.parametrize("hz", [10, 15, 30, 7])
def test_frames_lie_on_the_recorded_line_at_their_times(hz: int) -> None:
    car = Car(number=50, lane=1, along=wave(20, 14, steps=101, braking=1.5), first=4)
    found = staged([car], hz=hz, seconds=5.0, change=0.0)
    track = found.recordings.tracks[0]
    frames = found.recordings.frames[track["offset"] : track["offset"] + track["count"]]
    times = (track["first"] + np.arange(track["count"])) / hz
    assert 0.4 - 1e-6 <= times[0] < 0.4 + 1 / hz
    assert 10.4 - 1 / hz < times[-1] <= 10.4 + 1e-6
    wanted = np.interp(times, 0.4 + np.arange(101) * 0.1, car.along)
    np.testing.assert_allclose(np.diff(frames[:, 0]), np.diff(wanted), atol=1e-3)
    np.testing.assert_allclose(frames[:, 1], found.corridor.lane_width, atol=1e-3)
    assert track["fastest"] == pytest.approx(14, abs=0.1)


def test_a_start_is_a_moment_of_a_car_that_drives_on() -> None:
    found = staged(platoon())
    starts, tracks, frames = found.recordings.starts, found.recordings.tracks, found.recordings.frames
    assert len(starts) > 20
    for start in starts:
        track = tracks[start["track"]]
        at = start["frame"] - track["first"]
        assert 0 <= at < track["count"]
        assert start["frame"] + 90 <= 150
        own = frames[track["offset"] + at : track["offset"] + min(at + 91, int(track["count"]))]
        seconds = (len(own) - 1) / 15
        assert start["pace"] == pytest.approx((own[-1, 0] - own[0, 0]) / seconds, rel=0.05)
        assert np.abs(own[:, 3] - own[0, 3]).max() >= 3


def test_starts_one_after_the_other_are_of_different_cars() -> None:
    starts = staged(platoon()).recordings.starts
    cars = len(set(starts["track"].tolist()))
    assert len(set(starts["track"][:cars].tolist())) == cars


def test_every_car_may_be_taken_if_no_change_is_asked_for() -> None:
    steady = [Car(number=50 + place, lane=1, along=wave(20 + 40 * place, 14, steps=101)) for place in range(3)]
    assert len(staged(steady, change=0.0).recordings.starts) > 0
    with pytest.raises(ValueError, match=r"changes its speed by 3 m/s \(world\.change\)"):
        staged(steady)


def test_a_lorry_a_bicycle_and_a_car_that_touches_another_are_not_taken() -> None:
    braking = wave(20, 14, steps=101, braking=1.5)
    beside = [
        Car(number=1000, lane=0, along=braking, length=16.0, kind="truck"),
        Car(number=1001, lane=1, along=braking, kind="bicycle"),
        Car(number=1002, lane=2, along=braking),
        Car(number=1003, lane=2, along=[place + 4.7 for place in braking]),
    ]
    with pytest.raises(ValueError, match="no car on its lanes"):
        staged(beside)


def test_a_recording_that_is_too_short_is_refused() -> None:
    with pytest.raises(ValueError, match=r"recorded for 10\.0 s, an episode lasts 12 s"):
        staged(seconds=12.0)


def test_a_scene_without_road_users_is_refused() -> None:
    with pytest.raises(ValueError, match="no road user that moves"):
        staged([])


def test_a_parked_car_is_there_all_the_time() -> None:
    text = with_static(scene(ROAD, platoon()), ROAD, 150, 2)
    found = stage(recording(markup.parsed(text.encode()), "scene"), 15, 6.0, 3.0)
    assert found.recordings.tracks["stands"].sum() == 1
    parked = int(np.flatnonzero(found.recordings.tracks["stands"])[0])
    assert parked not in found.recordings.starts["track"]


def test_road_users_far_from_the_lanes_are_left_out() -> None:
    far = Car(number=1000, lane=40, along=wave(20, 14, steps=101))
    assert len(staged([*platoon(), far]).recordings.tracks) == len(platoon())
