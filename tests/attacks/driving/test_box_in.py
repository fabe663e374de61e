"""BoxIn: it changes lane only while there is room, also after the manoeuvre has begun."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDict

from cavbench.attacks.driving.box_in import BoxIn
from cavbench.driving import ObservationThreat
from cavbench.driving.access import Enforcer
from cavbench.driving.sets import Traffic
from cavbench.driving.traffic import View
from cavbench.driving.victim import CountedPolicy
from tests.attacks.driving.victims import FEATURES, observations, victim

LEFT = 1
"""The role of the car on the victim's left."""


def ordered(*others: tuple[float, float], crashed: tuple[int, ...] = (), car: int = LEFT) -> float:
    """Where a car is told to steer, by default the one on the left: it is on lane 0 beside the victim's new lane 2.

    Other cars are at (x, y).
    """
    cars = [(0.0, 8.0), (1.0, 0.0), (40.0, 8.0), *others]
    x, y = torch.tensor(cars, dtype=torch.float64).T[:, None]
    zero = torch.zeros_like(x)
    broken = zero.index_fill(1, torch.tensor(crashed, dtype=torch.int64), 1.0)
    view = View(x, y, zero + 20, zero, broken, zero, zero + 3)
    threat = ObservationThreat(traffic=Traffic(cars=2))
    enforcer = Enforcer(CountedPolicy(victim("discrete")), threat, "oblivious", FEATURES, torch.Generator())
    seen = observations(1)
    oracle = enforcer.begin(seen, view=view)
    state = TensorDict({"cars": torch.tensor([[2, LEFT]])}, batch_size=[1])
    BoxIn().step(seen, oracle, state)
    assert enforcer.orders is not None
    return float(enforcer.orders[0, car, 2]) if bool(enforcer.orders[0, car, 0]) else float("nan")


def test_a_car_takes_its_place_beside_the_victim_where_there_is_room() -> None:
    assert ordered((60.0, 4.0)) == 4.0


def test_a_car_that_crashed_gives_its_place_to_another_one() -> None:
    assert math.isnan(ordered((30.0, 4.0), crashed=(LEFT,)))
    assert ordered((30.0, 4.0), crashed=(LEFT,), car=3) == 4.0


def test_a_car_without_room_stays_on_its_lane() -> None:
    assert ordered((3.0, 4.0)) == 0.0
