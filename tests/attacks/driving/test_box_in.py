"""BoxIn: it changes lane only while there is room, also after the manoeuvre has begun."""

from __future__ import annotations

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


def ordered(*others: tuple[float, float]) -> float:
    """Where the car on the left is told to steer: it is on lane 0 beside the victim's new lane 2, other cars are at (x, y)."""
    cars = [(0.0, 8.0), (1.0, 0.0), (40.0, 8.0), *others]
    x, y = torch.tensor(cars, dtype=torch.float64).T[:, None]
    zero = torch.zeros_like(x)
    view = View(x, y, zero + 20, zero, zero, zero, zero + 3)
    threat = ObservationThreat(traffic=Traffic(cars=2))
    enforcer = Enforcer(CountedPolicy(victim("discrete")), threat, "oblivious", FEATURES, torch.Generator())
    seen = observations(1)
    oracle = enforcer.begin(seen, view=view)
    state = TensorDict({"cars": torch.tensor([[2, LEFT]])}, batch_size=[1])
    BoxIn().step(seen, oracle, state)
    assert enforcer.orders is not None
    return float(enforcer.orders[0, LEFT, 2])


def test_a_car_takes_its_place_beside_the_victim_where_there_is_room() -> None:
    assert ordered((60.0, 4.0)) == 4.0


def test_a_car_without_room_stays_on_its_lane() -> None:
    assert ordered((3.0, 4.0)) == 0.0
