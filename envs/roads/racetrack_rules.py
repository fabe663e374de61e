"""The rules of the racetrack: start and reward of highway-env's envs/racetrack_env.py in compiled code."""

from __future__ import annotations

import math

import numpy as np

from cavbench.compiled import inner
from cavbench.envs.highway.dynamics import linear_map
from cavbench.envs.roads.bodies import is_free, put_body
from cavbench.envs.roads.generator import Generator, next_below, next_uniform
from cavbench.envs.roads.lanes import CIRCULAR, heading_at, position
from cavbench.envs.roads.racetrack import FIRST_BEND, START
from cavbench.envs.roads.state import Bodies, Body, Episode, Floats, Kind, Parameters, Road

IDM = int(Kind.IDM)
ROOM = 20.0
"""A further car is so far in m from all others, or left out."""


@inner
def spawn(road: Road, bodies: Bodies, episode: Episode, generator: Generator, parameters: Parameters) -> None:
    """RacetrackEnv._make_vehicles with one other car, as it is by default, or more, each on a random lane with some room."""
    own = next_below(generator, 2)
    lane = road.lanes[road.spots[START] + own]
    along = next_uniform(generator, 20.0, 50.0)
    x, y = position(lane, along, 0.0)
    put_body(road, bodies[0], parameters.ego, x, y, heading_at(lane, along), lane.speed_limit)
    lane = road.lanes[road.spots[FIRST_BEND] + own]
    along = next_uniform(generator, 0.0, road.lanes[road.spots[FIRST_BEND]].length)
    speed = 6.0 + next_uniform(generator, 0.0, 3.0)
    x, y = position(lane, along, 0.0)
    put_body(road, bodies[1], IDM, x, y, heading_at(lane, along), speed)
    episode.ego, episode.cars = 0, 2
    for _ in range(1, episode.traffic):
        lane = road.lanes[next_below(generator, road.lane_count)]
        along = next_uniform(generator, 0.0, lane.length)
        speed = 6.0 + next_uniform(generator, 0.0, 3.0)
        x, y = position(lane, along, 0.0)
        if is_free(bodies, episode.cars, x, y, ROOM):
            put_body(road, bodies[episode.cars], IDM, x, y, heading_at(lane, along), speed)
            episode.cars += 1
    episode.bodies = episode.cars


@inner
def reward(road: Road, ego: Body, steering: float, on_road: bool, parts: Floats) -> float:
    """RacetrackEnv._reward for a float32 steering in [-1, 1]; `parts` [4]: centring, action, collision, on the road.

    Where the lane is straight, highway-env adds in float32, because the distance to the centre is then a number of Python.
    """
    # A power of Python's numbers is the C library's, which may differ from a product in the last bit. A constant exponent would
    # become a product.
    square = math.pow(ego.across, 2.0 + 0.0 * ego.across)
    parts[0] = 1 / (1 + 4 * square)
    size = np.float32(abs(steering))
    parts[1] = size
    parts[2] = 1.0 if ego.crashed else 0.0
    parts[3] = 1.0 if on_road else 0.0
    cost = np.float32(-0.3) * size
    if road.lanes[ego.lane].kind == CIRCULAR:
        value = parts[0] + np.float64(cost) - parts[2]
    else:
        value = np.float64(np.float32(np.float32(np.float32(parts[0]) + cost) - np.float32(parts[2])))
    return linear_map(value, -1.0, 1.0, 0.0, 1.0) * parts[3]
