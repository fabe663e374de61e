"""The way of the ego: its stretches fit together, or the message is one line."""

from __future__ import annotations

import math

import pytest

from cavbench.driving.way import Stretch, Way

FIRST = Stretch(x=0, y=0, heading=0, length=10)
BEND = Stretch(x=10, y=0, heading=0, length=5 * math.pi, curvature=0.1)
LAST = Stretch(x=20, y=10, heading=math.pi / 2, length=10)


def test_a_way_knows_where_its_stretches_begin() -> None:
    way = Way(stretches=(FIRST, BEND, LAST), lanes=2, start=0, start_lane=0)
    assert way.stations == (0, 10, pytest.approx(10 + 5 * math.pi))
    assert way.sharpest == 0.1
    assert BEND.end == pytest.approx((20, 10, math.pi / 2))


@pytest.mark.parametrize("stretches", [(), (BEND, LAST), (FIRST, BEND), (FIRST, LAST)])
def test_stretches_that_do_not_fit_are_refused_in_one_line(stretches: tuple[Stretch, ...]) -> None:
    with pytest.raises(ValueError, match="a way") as refused:
        Way(stretches=stretches, lanes=2, start=0, start_lane=0)
    assert "\n" not in str(refused.value)
