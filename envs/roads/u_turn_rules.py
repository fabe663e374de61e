"""The rules of the U-turn: start and reward of highway-env's envs/u_turn_env.py in compiled code."""

from __future__ import annotations

from cavbench.compiled import inner
from cavbench.envs.highway.dynamics import clip, linear_map
from cavbench.envs.roads.bodies import is_free, put_body
from cavbench.envs.roads.generator import Generator, next_below, next_normal, next_uniform
from cavbench.envs.roads.lanes import heading_at, position
from cavbench.envs.roads.state import Bodies, Episode, Floats, Kind, Parameters, Road

EGO_SPEED = 16.0
PARTS, LANES = (0, 0, 1, 1, 2, 2), (0, 1, 1, 0, 0, 1)
PLACES, SPEEDS = (25.0, 56.0, 0.5, 17.5, 1.0, 30.0), (13.5, 14.5, 4.5, 5.5, 3.5, 5.5)
"""Part of the road, lane, place in m and speed in m/s of the six cars, about."""
SPREAD, ROOM = 2.0, 15.0
"""Standard deviation in m and m/s; a further car is so far in m from all others, or left out."""
IDM = int(Kind.IDM)


@inner
def spawn(road: Road, bodies: Bodies, episode: Episode, generator: Generator, parameters: Parameters) -> None:
    """UTurnEnv._make_vehicles; only the first of the six cars draws its exponent. Further cars are anywhere."""
    x, y = position(road.lanes[road.spots[0]], 0.0, 0.0)
    put_body(road, bodies[0], parameters.ego, x, y, 0.0, EGO_SPEED)
    bodies[0].route = bodies[0].lane
    episode.ego, episode.cars = 0, 1
    for number in range(episode.traffic):
        more = number >= len(PLACES)
        part = next_below(generator, len(PARTS) // 2) if more else PARTS[number]
        lane = road.lanes[road.spots[part] + (next_below(generator, 2) if more else LANES[number])]
        along = next_uniform(generator, 0.0, lane.length) if more else PLACES[number] + next_normal(generator) * SPREAD
        speed = SPEEDS[number % len(SPEEDS)] + next_normal(generator) * SPREAD
        x, y = position(lane, along, 0.0)
        if more and not is_free(bodies, episode.cars, x, y, ROOM):
            continue
        car = bodies[episode.cars]
        put_body(road, car, IDM, x, y, heading_at(lane, along), speed)
        car.route = car.lane
        if number == 0:
            car.delta = next_uniform(generator, 3.5, 4.5)
        episode.cars += 1
    episode.bodies = episode.cars


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
