"""highway-env's search for neighbours (road/road.py).

`order` lists the vehicles by position (ties: by number), so that neighbours are found by searching outwards.
"""

from __future__ import annotations

from cavbench.compiled import inner
from cavbench.envs.highway.dynamics import is_on_lane
from cavbench.envs.highway.state import Integers, Vehicles

NEIGHBOUR_MARGIN = 1.0
NO_ONE = -1


@inner
def sort_by_position(vehicles: Vehicles, order: Integers) -> None:
    """Sort `order` [N] in place, by insertion sort, because it is nearly sorted from the previous frame."""
    for place in range(1, order.size):
        moved = order[place]
        x = vehicles[moved].x
        slot = place - 1
        while slot >= 0 and (vehicles[order[slot]].x > x or (vehicles[order[slot]].x == x and order[slot] > moved)):
            order[slot + 1] = order[slot]
            slot -= 1
        order[slot + 1] = moved


@inner
def front_vehicle(vehicles: Vehicles, order: Integers, place: int, lane: int) -> int:
    """Road.neighbour_vehicles: the nearest vehicle on `lane`, level with or ahead of the vehicle at `place` of `order`.

    Returns its number, or NO_ONE. Among vehicles at the same position the last in highway-env's order is taken.
    """
    x = vehicles[order[place]].x
    first = place
    while first > 0 and vehicles[order[first - 1]].x == x:
        first -= 1
    found = NO_ONE
    for candidate in range(first, order.size):
        other = order[candidate]
        if found >= 0 and vehicles[other].x > vehicles[found].x:
            break
        if candidate != place and is_on_lane(vehicles[other], lane, NEIGHBOUR_MARGIN):
            found = other
    return found


@inner
def rear_vehicle(vehicles: Vehicles, order: Integers, place: int, lane: int) -> int:
    """Road.neighbour_vehicles: the nearest vehicle on `lane` behind the vehicle at `place` of `order`.

    Returns its number, or NO_ONE. Among vehicles at the same position the first in highway-env's order is taken.
    """
    x = vehicles[order[place]].x
    found = NO_ONE
    for candidate in range(place - 1, -1, -1):
        other = order[candidate]
        if found >= 0 and vehicles[other].x < vehicles[found].x:
            break
        if vehicles[other].x < x and is_on_lane(vehicles[other], lane, NEIGHBOUR_MARGIN):
            found = other
    return found
