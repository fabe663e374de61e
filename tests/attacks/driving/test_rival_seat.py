"""What a learned driver of the traffic sees, which cars it takes, and what its choices mean."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.attacks.driving.rival_seat import (
    ACTIONS,
    FEATURES,
    NEAR,
    SIDES,
    empty,
    orders,
    seated,
    seen,
    told,
)
from cavbench.driving.sets import Traffic
from cavbench.driving.traffic import View

BOUNDS = Traffic(cars=1)
LANES = 3
AWAY, GO_ON, TOWARDS = range(SIDES)
FAR = (-900.0, 0.0, 20.0)


def road(*cars: tuple[float, float, float], crashed: tuple[int, ...] = ()) -> View:
    """One road of three lanes with cars (x, y, speed), the victim's first; others stand far behind."""
    placed = [*cars, *[(FAR[0] - 60 * number, *FAR[1:]) for number in range(NEAR + 2 - len(cars))]]
    x, y, speed = torch.tensor(placed, dtype=torch.float64).T[:, None]
    zero = torch.zeros_like(x)
    broken = zero.clone()
    broken[:, list(crashed)] = 1.0
    return View(x, y, speed, zero, broken, zero, zero + LANES)


def mirrored(view: View) -> View:
    """The same road with left and right exchanged."""
    return view._replace(y=4.0 * (LANES - 1) - view.y, heading=-view.heading)


def chosen(acceleration: int, side: int) -> Tensor:
    return torch.tensor([[SIDES * acceleration + side]])


def place_of(view: View, seats: TensorDict, *sides: int) -> float:
    for side in sides:
        seats = told(view, seats, chosen(2, side), BOUNDS)
    return float(seats["y"])


def test_it_takes_the_nearest_cars_each_once_and_keeps_them() -> None:
    view = road((0, 4, 25), (40, 4, 25), (12, 0, 25), (-30, 4, 25), (20, 8, 25))
    seats = seated(view, empty(1, 3))
    assert seats["car"].tolist() == [[2, 4, 1]]
    assert seats["y"].tolist() == [[0.0, 8.0, 4.0]]
    nearer = road((0, 4, 25), (5, 4, 25), (12, 0, 25), (-30, 4, 25), (20, 8, 25))
    assert seated(nearer, seats)["car"].tolist() == seats["car"].tolist()


@pytest.mark.parametrize(
    "gone", [road((0, 4, 25), (12, 0, 25), (30, 4, 25), crashed=(1,)), road((0, 4, 25), (-16, 0, 9), (30, 4, 25))]
)
def test_a_car_that_crashed_or_was_left_behind_is_given_up(gone: View) -> None:
    seats = seated(road((0, 4, 25), (12, 0, 25), (30, 4, 25)), empty(1, 1))
    assert seats["car"].item() == 1
    assert seated(gone, seats)["car"].item() == 2


def test_an_empty_road_gives_no_orders() -> None:
    view = road((0, 4, 25))
    seats = told(view, seated(view, empty(1, 2)), torch.zeros(1, 2, dtype=torch.int64), BOUNDS)
    assert not bool(orders(view, seats).driven.any())


def test_choices_are_places_beside_the_last_one_on_the_road() -> None:
    view = road((0, 8, 25), (12, 0, 25))
    seats = seated(view, empty(1, 1))
    assert place_of(view, seats, GO_ON) == 0
    assert place_of(view, seats, TOWARDS) == 4
    assert place_of(view, seats, TOWARDS, TOWARDS, TOWARDS) == 8, "not beyond the victim"
    assert place_of(view, seats, TOWARDS, AWAY, AWAY) == 0, "not off the road"
    assert place_of(mirrored(view), seated(mirrored(view), empty(1, 1)), TOWARDS) == 4


def test_the_accelerations_are_within_the_bounds() -> None:
    view, bounds = road((0, 8, 25), (12, 0, 25)), replace(BOUNDS, acceleration=1.5, braking=4.0)
    seats = seated(view, empty(1, 1))
    found = {float(told(view, seats, torch.tensor([[choice]]), bounds)["acceleration"]) for choice in range(ACTIONS)}
    assert found == {-4.0, -2.0, 0.0, 1.5}
    given = orders(view, told(view, seats, chosen(0, TOWARDS), bounds))
    assert given.driven.nonzero().tolist() == [[0, 1]]
    assert given.acceleration[0, 1] == -4
    assert given.y[0, 1] == 4


def test_left_and_right_look_the_same() -> None:
    view = road((0, 0, 25), (12, 4, 22), (30, 8, 24), (-8, 4, 27))
    view = view._replace(heading=view.heading + 0.1)
    other = mirrored(view)
    one, two = (told(each, seated(each, empty(1, 2)), torch.tensor([[3, 8]]), BOUNDS) for each in (view, other))
    assert one["y"].tolist() != two["y"].tolist()
    torch.testing.assert_close(seen(view, one, BOUNDS), seen(other, two, BOUNDS))
    assert seen(view, one, BOUNDS).shape == (1, 2, 1 + NEAR, FEATURES)


@pytest.mark.parametrize("cars", [1, 2, 5])
def test_with_few_cars_on_the_road_it_sees_the_same_as_with_more_out_of_sight(cars: int) -> None:
    placed = [(0.0, 0.0, 20.0), (12.0, 4.0, 22.0), (30.0, 8.0, 24.0), (-8.0, 4.0, 27.0), (40.0, 0.0, 21.0)][: cars + 1]
    many = road(*placed)
    few = View(*(values[:, : cars + 1] for values in many))
    rows = [seen(view, seated(view, empty(1, 1)), BOUNDS) for view in (few, many)]
    torch.testing.assert_close(*rows, rtol=0, atol=0)


def test_it_sees_the_victim_its_room_and_the_cars_but_itself() -> None:
    close, free = (road((0, 0, 20), (x, 4, 20), (50, 8, 20)) for x in (9.0, 30.0))
    rows = [seen(view, seated(view, empty(1, 1)), BOUNDS)[0, 0] for view in (close, free)]
    # 3 m + 0.1 s * 20 m/s are not there in 9 m - 5 m, and are in 25 m.
    assert rows[0][0, 9] == 0
    assert rows[1][0, 9] == 1
    assert rows[0][0, 1] == pytest.approx(0.3)
    assert int((rows[1][1:, 0] > 0).sum()) == 1, "the car ahead; neither itself nor the victim nor those out of sight"
