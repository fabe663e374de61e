"""The straightened road of a scene: lanes and places are what they were, wherever the road lies, or it is refused."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cavbench.envs.recorded.commonroad import recording
from cavbench.envs.recorded.corridor import Corridor, corridor
from cavbench.envs.recorded.scene import Recording
from cavbench.formats import markup
from tests.envs.recorded.scenes import Car, Road, platoon, scene, wave

CAR = [Car(number=50, lane=1, along=wave(40, 12, steps=5))]


def recorded(road: Road, cars: Sequence[Car] = CAR, **options: object) -> Recording:
    return recording(markup.parsed(scene(road, cars, **options).encode()), "scene")  # type: ignore[arg-type]


def straightened(road: Road, **options: object) -> Corridor:
    return corridor(recorded(road, **options))


def places(road: Road, found: Corridor, alongs: Sequence[float], acrosses: Sequence[float]) -> np.ndarray:
    """Coordinates on the straightened road of places on the road."""
    return found.coordinates(np.array([road.place(*pair) for pair in zip(alongs, acrosses, strict=True)]))


@settings(max_examples=25, deadline=None)
@given(
    heading=st.floats(-10, 10),
    x=st.floats(-1e5, 1e5),
    y=st.floats(-1e5, 1e5),
    lanes=st.integers(1, 6),
    width=st.floats(2.5, 5.0),
)
def test_a_road_is_the_same_wherever_it_lies(heading: float, x: float, y: float, lanes: int, width: float) -> None:
    road = Road(heading=heading, x=x, y=y, lanes=lanes, width=width)
    found = straightened(road, cars=[])
    assert found.lanes == lanes
    assert found.lane_width == pytest.approx(width, abs=1e-4)
    assert found.length == pytest.approx(300, abs=2)
    alongs, acrosses = [20.0, 150.0, 290.0], [0.5 * width, (lanes - 0.5) * width, 1.0]
    at = places(road, found, alongs, acrosses)
    np.testing.assert_allclose(at[:, 1], np.array(acrosses) - width / 2, atol=1e-3)
    np.testing.assert_allclose(np.diff(at[:, 0]), np.diff(alongs), atol=1e-3)
    np.testing.assert_allclose(at[:, 2], 0, atol=1e-4)


def test_the_first_metre_is_where_the_lanes_begin() -> None:
    road = Road()
    assert places(road, straightened(road), [0.0], [5.25])[0, 0] == pytest.approx(0, abs=1.0)


@pytest.mark.parametrize("radius", [400.0, 1000.0])
def test_lanes_of_a_bend_become_straight(radius: float) -> None:
    road = Road(radius=radius)
    found = straightened(road)
    assert found.lanes == 3
    assert found.radius == pytest.approx(radius, rel=0.05)
    assert found.uneven < 0.25
    alongs = np.linspace(40, 260, 23)
    at = places(road, found, alongs, [5.25] * len(alongs))
    np.testing.assert_allclose(at[:, 1], at[:, 1].mean(), atol=0.1)
    assert np.abs(at[:, 2]).max() < 0.02
    # Metres at the other lanes are longer or shorter by their share of the radius.
    outer = places(road, found, alongs, [8.75] * len(alongs))
    assert np.diff(outer[:, 0]).mean() == pytest.approx(np.diff(at[:, 0]).mean(), rel=0.001)


def test_a_car_that_turns_right_has_a_larger_y_and_a_positive_heading() -> None:
    road = Road()
    found, x, y, heading = straightened(road), *road.place(100, 5.25)
    turned = heading - 0.2
    ahead = [x + 10 * math.cos(turned), y + 10 * math.sin(turned), turned]
    before, after = found.coordinates(np.array([[x, y, turned], ahead]))
    assert before[2] == pytest.approx(0.2, abs=1e-6)
    assert after[1] - before[1] == pytest.approx(10 * math.sin(0.2), abs=1e-3)


def test_a_road_that_bends_too_much_is_refused() -> None:
    with pytest.raises(ValueError, match="bends with a radius of"):
        straightened(Road(radius=60.0, length=150.0, pieces=8))


def test_a_road_that_is_too_short_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 80 m"):
        straightened(Road(length=60.0), cars=[])


def test_a_road_of_a_thousand_kilometres_is_refused_before_it_is_measured() -> None:
    with pytest.raises(ValueError, match="at most 5 km"):
        straightened(Road(length=1e6), cars=[])


def test_lanes_that_are_too_narrow_are_refused() -> None:
    with pytest.raises(ValueError, match="allowed are 2 to 6 m"):
        straightened(Road(width=1.2), cars=[])


def test_without_a_planning_problem_the_road_is_that_of_most_cars() -> None:
    assert straightened(Road(), cars=platoon(), problem=False).lanes == 3
    with pytest.raises(ValueError, match="neither a planning problem nor"):
        straightened(Road(), cars=[], problem=False)
    beside = [Car(number=50, lane=9, along=wave(40, 12, steps=5))]
    with pytest.raises(ValueError, match="beside its lanes"):
        straightened(Road(), cars=beside, problem=False)


def test_a_start_beside_the_lanes_is_refused() -> None:
    begins = 'planningProblem id="9999"><initialState><position><point><x>'
    beside = recorded(Road(), edit=lambda text: text.replace(begins, begins + "9"))
    with pytest.raises(ValueError, match="beside its lanes"):
        corridor(beside)


def test_a_lane_that_ends_does_not_count() -> None:
    road = Road(lanes=3)
    gone = road.number(2, 2)

    def edit(text: str) -> str:
        start = text.index(f'<lanelet id="{gone}">')
        return text[:start] + text[text.index("</lanelet>", start) + len("</lanelet>") :]

    assert straightened(road, edit=edit).lanes == 2


def test_references_to_lanelets_that_are_not_there_are_left_out() -> None:
    assert (
        straightened(Road(), edit=lambda text: text.replace('<successor ref="2"/>', '<successor ref="4711"/>')).lanes
        >= 2
    )
