"""The reader of CommonRoad scenes: what is written is read, and what readers differ on is refused in one line."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cavbench.envs.recorded import commonroad
from cavbench.envs.recorded.corridor import corridor
from cavbench.errors import UserError
from cavbench.formats import markup
from tests.envs.recorded.scenes import Car, Road, platoon, scene, wave, with_static

LANE = 'lanelet id="1"'
CARS = [Car(number=50, lane=1, along=wave(10, 12, steps=8), first=3)]


def read(folder: Path, text: str) -> commonroad.Recording:
    place = folder / "scene.xml"
    place.write_text(text, encoding="utf-8")
    return commonroad.read(place)


def swap(old: str, new: str, count: int = 1) -> Callable[[str], str]:
    """An edit that changes a part of a file, which must be there."""

    def edit(text: str) -> str:
        assert old in text
        return text.replace(old, new, count)

    return edit


@pytest.mark.parametrize("version", commonroad.VERSIONS)
def test_a_scene_is_read_as_it_was_written(tmp_path: Path, version: str) -> None:
    road, cars = Road(), platoon()
    found = read(tmp_path, scene(road, cars, version=version))
    assert (found.version, found.step_s, len(found.lanelets)) == (version, 0.1, 9)
    assert found.last == 100
    middle = found.lanelets[road.number(1, 1)]
    assert (middle.before, middle.after, middle.beside) == ((4,), (6,), (2, 8))
    np.testing.assert_allclose(middle.left[0], road.place(100, 3.5)[:2])
    assert [track.number for track in found.tracks] == [car.number for car in cars]
    for track, car in zip(found.tracks, cars, strict=True):
        assert (track.first, track.length, track.width, track.kind) == (0, 4.5, 1.8, "car")
        wanted = [road.place(along, (car.lane + 0.5) * road.width) for along in car.along]
        np.testing.assert_allclose(track.states[:, :3], wanted, atol=1e-12)
    assert found.problems[0].speed == 12


def test_a_car_that_comes_later_keeps_its_time_steps(tmp_path: Path) -> None:
    found = read(tmp_path, scene(cars=CARS))
    assert (found.tracks[0].first, len(found.tracks[0].states), found.last) == (3, 8, 10)


def test_a_parked_car_stands(tmp_path: Path) -> None:
    found = read(tmp_path, with_static(scene(), Road(), 150, 2))
    assert [track.moves for track in found.tracks if track.number == 777] == [False]


def test_a_shape_is_the_rectangle_around_it(tmp_path: Path) -> None:
    for shape, size in (
        ("<circle><radius>0.5</radius></circle>", (1.0, 1.0)),
        (
            "<rectangle><length>4</length><width>2</width><orientation>1.5707963267948966</orientation></rectangle>",
            (2.0, 4.0),
        ),
        (
            "<polygon><point><x>0</x><y>-1</y></point><point><x>4</x><y>-1</y></point><point><x>4</x><y>1</y></point></polygon>",
            (4.0, 2.0),
        ),
    ):
        old = "<rectangle><length>4.5</length><width>1.8</width></rectangle>"
        found = read(tmp_path, scene(cars=CARS, edit=swap(old, shape)))
        assert (found.tracks[0].length, found.tracks[0].width) == pytest.approx(size)
    # The rectangle of the triangle lies 2 m before the point that was recorded.
    plain = read(tmp_path, scene(cars=CARS)).tracks[0].states
    off = found.tracks[0].states[:, :2] - plain[:, :2]
    np.testing.assert_allclose(off, 2 * np.stack([np.cos(plain[:, 2]), np.sin(plain[:, 2])], 1), atol=1e-12)


def test_speeds_that_are_left_out_follow_from_places(tmp_path: Path) -> None:
    with_speeds = read(tmp_path, scene(cars=CARS)).tracks[0].states[:, 3]
    without = scene(cars=CARS, edit=lambda text: re.sub(r"<velocity><exact>[^<]*</exact></velocity>", "", text))
    np.testing.assert_allclose(read(tmp_path, without).tracks[0].states[:, 3], with_speeds, atol=1e-9)


STATE = "<time><exact>5</exact></time>"
HOSTILE: dict[str, tuple[Callable[[str], str], str]] = {
    "no lanes": (lambda text: re.sub(r"<lanelet .*?</lanelet>", "", text, flags=re.S), "no lanes"),
    "another root": (lambda text: text.replace("commonRoad", "openRoad"), "not of <commonRoad>"),
    "another version": (swap("2020a", "2017a"), "version '2017a'"),
    "no version": (swap('commonRoadVersion="2020a"', ""), "no commonRoadVersion"),
    "time step of zero": (swap('timeStepSize="0.1"', 'timeStepSize="0"'), "allowed are 0.01 to 1"),
    "time step of nan": (swap('timeStepSize="0.1"', 'timeStepSize="nan"'), "finite number"),
    "a place that is nan": (lambda text: re.sub(r"<x>[^<]*</x>", "<x>NaN</x>", text, count=1), "finite number"),
    "a place that is infinite": (lambda text: re.sub(r"<y>[^<]*</y>", "<y>1e400</y>", text, count=1), "finite number"),
    "a speed that is nan": (
        lambda text: re.sub(r"<velocity><exact>[^<]*", "<velocity><exact>nan", text),
        "finite number",
    ),
    "a speed of light": (lambda text: re.sub(r"<velocity><exact>[^<]*", "<velocity><exact>3e8", text), "at most 100"),
    "a time step twice": (swap(STATE, "<time><exact>4</exact></time>"), "steps must follow each other"),
    "a missing time step": (swap(STATE, "<time><exact>6</exact></time>"), "time step 6 where 5 is due"),
    "a time that is no number": (swap(STATE, "<time><exact>5.5</exact></time>"), "whole number"),
    "a time of an interval": (
        swap(STATE, "<time><intervalStart>5</intervalStart><intervalEnd>6</intervalEnd></time>"),
        "no <exact>",
    ),
    "two times": (swap(STATE, STATE + STATE), "<time> twice"),
    "a negative time": (lambda text: re.sub(r"<time><exact>\d+", "<time><exact>-2", text), "the first one is 0"),
    "a region": (
        lambda text: re.sub(r"<position><point>.*?</point></position>", "<position><circle/></position>", text),
        "not at a <point>",
    ),
    "an angle of an interval": (
        lambda text: re.sub(
            r"<orientation><exact>[^<]*</exact>", "<orientation><intervalStart>0</intervalStart>", text
        ),
        "is an interval",
    ),
    "sets of places": (swap("<trajectory>", "<occupancySet/><trajectory>"), "occupancySet"),
    "a lanelet twice": (swap('lanelet id="2"', LANE), "lanelet 1 stands twice"),
    "one id for two things": (swap('dynamicObstacle id="50"', 'dynamicObstacle id="1"'), "id 1 stands twice"),
    "an id that is no number": (swap(LANE, 'lanelet id="one"'), "whole number"),
    "borders of two lengths": (
        lambda text: re.sub(r"<leftBound>\s*<point>.*?</point>", "<leftBound>", text, count=1, flags=re.S),
        "as many on both sides",
    ),
    "a lane of one point": (
        lambda text: re.sub(r"(<(left|right)Bound>\s*<point>.*?</point>).*?(</\2Bound>)", r"\1\3", text, flags=re.S),
        "at least 2",
    ),
    "a direction that is none": (
        lambda text: text.replace('drivingDir="same"', 'drivingDir="up"', 1),
        "same or opposite",
    ),
    "no shape": (lambda text: re.sub(r"<shape>.*?</shape>", "<shape/>", text, flags=re.S), "no shape"),
    "a car without size": (swap("<length>4.5</length>", "<length>0</length>"), "allowed are up to 40 m"),
    "a car of a kilometre": (swap("<length>4.5</length>", "<length>1000</length>"), "allowed are up to 40 m"),
    "a document type": (swap("<commonRoad", "<!DOCTYPE commonRoad><commonRoad"), "document type"),
    "half a file": (lambda text: text[: len(text) // 2], "not XML"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_a_file_that_cannot_be_replayed_is_refused_in_one_line(tmp_path: Path, case: str) -> None:
    edit, said = HOSTILE[case]
    with pytest.raises(UserError) as raised:
        read(tmp_path, scene(cars=CARS, edit=edit))
    line = str(raised.value)
    assert said in line
    assert "scene.xml" in line
    assert "\n" not in line
    assert len(line) < 300


PLAIN = scene(cars=CARS)


@settings(max_examples=60, deadline=None)
@given(
    place=st.integers(0, len(PLAIN) - 1),
    length=st.integers(0, 400),
    text=st.text(st.sampled_from("0123456789.-eN<>/&x "), max_size=6),
)
def test_a_damaged_file_is_a_scene_or_one_line(place: int, length: int, text: str) -> None:
    damaged = PLAIN[:place] + text + PLAIN[place + length :]
    said = ""
    try:
        corridor(commonroad.recording(markup.parsed(damaged.encode()), "scene"))
    except ValueError as error:
        said = str(error)
    assert "\n" not in said
    assert len(said) < 300


@pytest.mark.parametrize("limit", ["MOST_LANELETS", "MOST_TRACKS", "MOST_STATES", "MOST_POINTS"])
def test_counts_are_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str) -> None:
    monkeypatch.setattr(commonroad, limit, 2 if limit == "MOST_LANELETS" else 0)
    with pytest.raises(UserError):
        read(tmp_path, scene(cars=CARS))


def test_a_recording_of_hours_is_refused(tmp_path: Path) -> None:
    late = [Car(number=50, lane=1, along=wave(10, 12, steps=8), first=36_000)]
    with pytest.raises(UserError, match="at most 600 s"):
        read(tmp_path, scene(cars=late))
