"""The rules of the U-turn: start and reward of highway-env's envs/u_turn_env.py in compiled code."""

from __future__ import annotations

from cavbench.compiled import inner
from cavbench.envs.highway.dynamics import clip, linear_map
from cavbench.envs.roads.bodies import put_body
from cavbench.envs.roads.generator import Generator, next_normal, next_uniform
from cavbench.envs.roads.lanes import heading_at, position
from cavbench.envs.roads.state import Bodies, Episode, Floats, Kind, Parameters, Road

EGO_SPEED = 16.0
PARTS, LANES = (0, 0, 1, 1, 2, 2), (0, 1, 1, 0, 0, 1)
PLACES, SPEEDS = (25.0, 56.0, 0.5, 17.5, 1.0, 30.0), (13.5, 14.5, 4.5, 5.5, 3.5, 5.5)
"""Part of the road, lane, place in m and speed in m/s of the six cars, about."""
SPREAD = 2.0
IDM = int(Kind.IDM)


@inner
def spawn(road: Road, bodies: Bodies, episode: Episode, generator: Generator, parameters: Parameters) -> None:
    """UTurnEnv._make_vehicles; only the first of the six cars draws its exponent."""
    x, y = position(road.lanes[road.spots[0]], 0.0, 0.0)
    put_body(road, bodies[0], parameters.ego, x, y, 0.0, EGO_SPEED)
    bodies[0].route = bodies[0].lane
    for number in range(6):
        lane = road.lanes[road.spots[PARTS[number]] + LANES[number]]
        along = PLACES[number] + next_normal(generator) * SPREAD
        speed = SPEEDS[number] + next_normal(generator) * SPREAD
        x, y = position(lane, along, 0.0)
        put_body(road, bodies[number + 1], IDM, x, y, heading_at(lane, along), speed)
        bodies[number + 1].route = bodies[number + 1].lane
        if number == 0:
            bodies[1].delta = next_uniform(generator, 3.5, 4.5)
    episode.ego, episode.cars, episode.bodies = 0, 7, 7


@inner
def reward(road: Road, bodies: Bodies, episode: Episode, on_road: bool, parameters: Parameters, parts: Floats) -> float:
    """UTurnEnv._reward; `parts` [4] become its `_rewards`: collision, lane (the right one counts as left), speed, on the road."""
    ego = bodies[episode.ego]
    low, high = parameters.reward_speed_low, parameters.reward_speed_high
    lane = road.lanes[ego.lane]
    parts[0] = 1.0 if ego.crashed else 0.0
    parts[1] = lane.number / max(road.edges[lane.edge].lanes - 1, 1)
    parts[2] = clip(linear_map(ego.speed, low, high, 0.0, 1.0), 0.0, 1.0)
    parts[3] = 1.0 if on_road else 0.0
    value = -1.0 * parts[0] + 0.1 * parts[1] + 0.4 * parts[2]
    return linear_map(value, -1.0, 0.4 + 0.1, 0.0, 1.0) * parts[3]
