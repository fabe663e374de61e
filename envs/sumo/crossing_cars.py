"""The cars of an episode at a crossing, from the seed of its scenario."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavbench.envs.highway.dynamics import VEHICLE_LENGTH
from cavbench.envs.sumo.cars import CAR, SPREAD, STANDING_GAP, TIME_GAP, Model
from cavbench.envs.sumo.crossing import LENGTH, ROUTES, SPEED_LIMIT
from cavbench.scenarios import Cell

EGO_SPEED, EGO_BEFORE = 10.0, (60.0, 90.0)
"""m/s, and m before the stop line, with which the ego starts."""
SPACING = 60.0
"""Mean distance in m between the front bumpers of a lane at density 1: a gap of five seconds."""
FIRST = {"south": 10.0, "north": 10.0, "east": 35.0, "west": 35.0}
"""m before the stop line from which cars start: those from the east and the west may have to stop there."""
BEHIND_NOBODY = 20.0
"""m ahead of the ego without a car."""
DESIRED_MEAN, DESIRED_DEVIATION, DESIRED_RANGE = 12.0, 1.5, (9.0, SPEED_LIMIT)
"""m/s that the cars of the traffic want to drive."""
TURNING = 0.3
"""Share of the cars that turn."""


def start(row: int, seed: int, cell: Cell, vehicles: int, ego: Model) -> NDArray[np.void]:
    """The cars [N] at the start, the ego first.

    Args:
        row: of the batch.
        seed: scenario seed, at least 0.
        cell: `lanes`, `density`.
        vehicles: most cars of the traffic: those nearest to the crossing.
        ego: what drives the ego.
    """
    draws = np.random.default_rng(seed)
    before, own = draws.uniform(*EGO_BEFORE), int(draws.integers(cell.lanes))
    spacing = SPACING / cell.density
    found = []
    for side in FIRST:
        for lane in range(cell.lanes if side in ("west", "east") else 1):
            most = max(1, int(LENGTH / spacing / (1 - SPREAD)))
            steps = spacing * draws.uniform(1 - SPREAD, 1 + SPREAD, most)
            places = FIRST[side] + draws.uniform(0, spacing) + np.cumsum(steps) - steps[0]
            # Nobody starts behind the ego.
            last = before - BEHIND_NOBODY - VEHICLE_LENGTH if side == "west" else LENGTH - 2 * VEHICLE_LENGTH
            turns = draws.uniform(size=len(places)) < TURNING
            chosen = draws.uniform(size=len(places))
            for place, turn, share in zip(places, turns, chosen, strict=True):
                if place < last:
                    found.append((float(place), _route(side, lane, cell.lanes, share if turn else None), lane))
    found = sorted(found)[:vehicles]
    cars = np.zeros(1 + len(found), dtype=CAR)
    cars["row"], cars["number"] = row, np.arange(len(cars))
    cars["model"] = draws.choice((Model.KRAUSS, Model.EIDM), len(cars))
    cars["desired"] = draws.normal(DESIRED_MEAN, DESIRED_DEVIATION, len(cars)).clip(*DESIRED_RANGE)
    cars["front"][1:] = [-place for place, _, _ in found]
    cars["route"][1:] = [route for _, route, _ in found]
    cars["lane"][1:] = [lane for _, _, lane in found]
    # The speed at which the shortest distance is safe.
    flowing = ((1 - SPREAD) * spacing - VEHICLE_LENGTH - STANDING_GAP) / TIME_GAP
    cars["speed"] = np.minimum(cars["desired"], flowing)
    cars[0] = (row, 0, ego, ROUTES.index(("west", "east")), own, -before, EGO_SPEED, SPEED_LIMIT)
    return cars


def _route(side: str, lane: int, lanes: int, share: float | None) -> int:
    """The route of a car: straight on without a `share`, otherwise one of the turns that are allowed from its lane."""
    opposite = {"west": "east", "east": "west", "south": "north", "north": "south"}[side]
    turns = [number for number, (start, end) in enumerate(ROUTES) if start == side and end != opposite]
    if side in ("west", "east"):
        # To the right from the lane on the right, to the left from the one on the left.
        allowed = {("west", "south"): lanes - 1, ("west", "north"): 0, ("east", "south"): 0}
        turns = [number for number in turns if allowed[ROUTES[number]] == lane]
    if share is None or not turns:
        return ROUTES.index((side, opposite))
    return turns[int(share * len(turns))]
