"""The cars of SUMO's traffic: their models, and where they start, from the seed of a scenario.

Nothing in a simulation is drawn by SUMO. It has random generators for lanes, which all cars there share, and they go on from one
episode to the next. So the models' own errors are off, and the cars differ by what is drawn here.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from cavbench.envs.highway.dynamics import VEHICLE_LENGTH, VEHICLE_WIDTH
from cavbench.envs.highway.spawn import EGO_SPEED
from cavbench.envs.sumo.motorway import ON_MOTORWAY, ON_RAMP, RAMP_LENGTH, START
from cavbench.scenarios import Cell


class Model(IntEnum):
    """What drives a car."""

    EGO = 0
    """cavbench; SUMO is told where it is."""
    IDM = 1
    """SUMO's IDM, for `victim=idm`."""
    KRAUSS = 2
    EIDM = 3


CAR = np.dtype(
    [
        ("row", np.int64),  # of the batch
        ("number", np.int64),  # of the car in its episode; 0 is the ego
        ("model", np.int64),
        ("route", np.int64),  # of the layout
        ("lane", np.int64),  # from the left
        (
            "front",
            np.float64,
        ),  # m along the road up to the front bumper; below 0, minus the distance to the end of its stretch
        ("speed", np.float64),  # m/s
        ("desired", np.float64),  # m/s
    ]
)
"""A car at the start of an episode."""

PERIOD_MS = 67
"""Milliseconds per step: SUMO's times are whole ones, so that 1/15 s are 67 ms, and 450 steps 30.15 s."""
ACTION_STEPS = 3
"""SUMO's cars decide every 0.2 s, and keep their acceleration in between. Deciding at each step takes 2.4 times as long."""
ACCELERATION, BRAKING, TIME_GAP, STANDING_GAP = 2.6, 4.5, 1.0, 2.5
"""SUMO's default values: m/s2, m/s2, s, and m between bumpers."""
SPACING = 37.0
"""highway-env's distance in m between the centres of cars at 25 m/s, on a road of one lane."""
IDM_SPEED = 30.0
"""m/s that the rule-based driver wants."""
DESIRED_MEAN, DESIRED_DEVIATION, DESIRED_RANGE = 24.0, 3.0, (18.0, 30.0)
"""m/s that the cars of the traffic want to drive."""
SPREAD = 0.3
"""The distance to the next car of a lane is drawn within this share around its mean."""
AHEAD_OF_EGO = 40.0
"""m of the ego's lane without another front bumper, besides the way in which it brakes to the speed of the traffic."""
RAMP_SHARE = 0.2
"""Share of the traffic on the ramp; the others are ahead of the ego, as on `highway`."""
REACH = 600.0
"""m ahead of the ego in which cars start."""
RAMP_FIRST, RAMP_SPEED = (100.0, 220.0), 20.0
"""m before the end of the ramp at which its first car is, so that it meets the ego; and m/s on the ramp."""
SLOWEST = 5.0


def types() -> str:
    """SUMO's XML of the types of cars, named as in `Model`."""
    decides = ACTION_STEPS * PERIOD_MS / 1000
    common = (
        f'length="{VEHICLE_LENGTH:g}" width="{VEHICLE_WIDTH:g}" minGap="{STANDING_GAP:g}" accel="{ACCELERATION:g}" '
        f'decel="{BRAKING:g}" tau="{TIME_GAP:g}" speedDev="0" laneChangeModel="SL2015" actionStepLength="{decides:g}"'
    )
    own = {
        Model.EGO: 'carFollowModel="Krauss" sigma="0" maxSpeed="60"',
        Model.IDM: f'carFollowModel="IDM" maxSpeed="{IDM_SPEED:g}"',
        Model.KRAUSS: 'carFollowModel="Krauss" sigma="0"',
        Model.EIDM: 'carFollowModel="EIDM" sigmaleader="0" sigmagap="0" sigmaerror="0"',
    }
    lines = [f'<vType id="{model.name}" {common} {special}/>' for model, special in own.items()]
    return "\n".join(("<routes>", *lines, "</routes>"))


def start(row: int, seed: int, cell: Cell, vehicles: int, ego: Model) -> NDArray[np.void]:
    """The cars [N] of an episode on the motorway at its start, the ego first.

    Args:
        row: of the batch.
        seed: scenario seed, at least 0.
        cell: `lanes`, `density`.
        vehicles: number of cars of the traffic; fewer, if the road ahead has no room for them.
        ego: what drives the ego.
    """
    draws, lanes, density = np.random.default_rng(seed), cell.lanes, cell.density
    spacing = lanes * SPACING * np.exp(-lanes / 8) / density
    # The speed at which the shortest distance is safe.
    flowing = max(SLOWEST, ((1 - SPREAD) * spacing - VEHICLE_LENGTH - STANDING_GAP) / TIME_GAP)
    own_lane = int(draws.integers(lanes))
    on_ramp = round(RAMP_SHARE * vehicles)
    chosen = _places(draws, lanes, own_lane, spacing, flowing)[: vehicles - on_ramp]
    cars = np.zeros(1 + len(chosen) + on_ramp, dtype=CAR)
    cars["row"] = row
    cars["number"] = np.arange(len(cars))
    cars["model"] = draws.choice((Model.KRAUSS, Model.EIDM), len(cars))
    cars["desired"] = draws.normal(DESIRED_MEAN, DESIRED_DEVIATION, len(cars)).clip(*DESIRED_RANGE)
    cars[0] = (row, 0, ego, ON_MOTORWAY, own_lane, START, EGO_SPEED, IDM_SPEED)
    through = cars[1 : 1 + len(chosen)]
    through["front"] = [START + place for place, _ in chosen]
    through["lane"] = [lane for _, lane in chosen]
    through["speed"] = np.minimum(through["desired"], flowing)
    ramp = cars[1 + len(chosen) :]
    gaps = (VEHICLE_LENGTH + STANDING_GAP + TIME_GAP * RAMP_SPEED) * draws.uniform(1, 2, on_ramp) / min(density, 1.0)
    ramp["route"] = ON_RAMP
    ramp["front"] = -draws.uniform(*RAMP_FIRST) - np.cumsum(gaps) + (gaps[0] if on_ramp else 0)
    ramp["speed"] = RAMP_SPEED
    return cars[cars["front"] > VEHICLE_LENGTH - RAMP_LENGTH]


def _places(
    draws: np.random.Generator, lanes: int, own_lane: int, spacing: float, flowing: float
) -> list[tuple[float, int]]:
    """m from the ego, and lanes, of cars on the motorway, the nearest first."""
    braking = max(EGO_SPEED**2 - flowing**2, 0.0) / (2 * BRAKING)
    found = []
    for lane in range(lanes):
        steps = spacing * draws.uniform(1 - SPREAD, 1 + SPREAD, int(REACH / (spacing * (1 - SPREAD))) + 1)
        first = draws.uniform(0, spacing) + (AHEAD_OF_EGO + braking if lane == own_lane else VEHICLE_LENGTH)
        places = first + np.cumsum(steps) - steps[0]
        found += [(float(place), lane) for place in places[places < REACH]]
    return sorted(found)
