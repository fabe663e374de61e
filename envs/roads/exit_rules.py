"""The rules of the exit: start and reward of highway-env's envs/exit_env.py in compiled code."""

from __future__ import annotations

from cavbench.compiled import inner
from cavbench.envs.highway.dynamics import clip, linear_map
from cavbench.envs.roads.bodies import put_body
from cavbench.envs.roads.exit import EXIT_LANE, RAMP, START
from cavbench.envs.roads.generator import Generator, next_double, next_uniform
from cavbench.envs.roads.lanes import local_coordinates, position
from cavbench.envs.roads.state import Bodies, Body, Episode, Floats, Kind, Parameters, Road

EGO_SPEED, EGO_SPACING = 25.0, 2.0
START_OFFSETS = 3
"""Vehicle.create_random: the first car of a road starts behind so many and about one more spacings."""
CONTINUOUS, IDM = int(Kind.CONTINUOUS), int(Kind.IDM)


@inner
def draw_lane(generator: Generator, lanes: int) -> int:
    """Generator.choice with probabilities in proportion to the number of the lane: cars are on the right."""
    total = 0.0
    for number in range(lanes):
        total += number
    last = 0.0
    for number in range(lanes):
        last += number / total
    drawn, below = next_double(generator), 0.0
    for number in range(lanes):
        below += number / total
        if below / last > drawn:
            return number
    return lanes - 1


@inner
def put_ahead(
    road: Road,
    bodies: Bodies,
    episode: Episode,
    generator: Generator,
    lane: int,
    kind: int,
    speed: float,
    spacing: float,
) -> None:
    """Vehicle.create_random: a car ahead of all others on a lane."""
    own = road.lanes[road.spots[START] + lane]
    offset = spacing * (12 + 1.0 * speed) * road.factor
    farthest = START_OFFSETS * offset
    for number in range(episode.cars):
        along, _ = local_coordinates(own, bodies[number].x, bodies[number].y)
        farthest = along if number == 0 else max(farthest, along)
    farthest += offset * next_uniform(generator, 0.9, 1.1)
    x, y = position(own, farthest, 0.0)
    put_body(road, bodies[episode.cars], kind, x, y, own.heading, speed)
    episode.cars += 1
    episode.bodies = episode.cars


@inner
def expected_place(road: Road) -> float:
    """The mean of the places at which the ego starts, in m along the road."""
    return (START_OFFSETS + 1) * EGO_SPACING * (12 + 1.0 * EGO_SPEED) * road.factor


@inner
def spawn(road: Road, bodies: Bodies, episode: Episode, generator: Generator, parameters: Parameters) -> None:
    """ExitEnv._create_vehicles."""
    episode.ego = episode.cars = 0
    put_ahead(road, bodies, episode, generator, 0, parameters.ego, EGO_SPEED, EGO_SPACING)
    lanes = road.edges[road.lanes[road.spots[START]].edge].lanes
    for number in range(1, episode.traffic + 1):
        lane = draw_lane(generator, lanes)
        speed = road.lanes[road.spots[START] + lane].speed_limit
        put_ahead(road, bodies, episode, generator, lane, IDM, speed, 1 / episode.density)
        bodies[number].route = bodies[number].lane
        bodies[number].changes_lanes = False


@inner
def is_success(road: Road, ego: Body) -> bool:
    """ExitEnv._is_success: whether the ego aims for the exit; a continuous one must be on it."""
    lane = ego.lane if ego.kind == CONTINUOUS else ego.target_lane
    return lane in (road.spots[EXIT_LANE], road.spots[RAMP])


@inner
def reward(road: Road, ego: Body, parameters: Parameters, parts: Floats) -> float:
    """ExitEnv._reward; `parts` [4] become its `_rewards`: collision, goal, speed, number of the lane."""
    low, high = parameters.reward_speed_low, parameters.reward_speed_high
    lane = ego.lane if ego.kind == CONTINUOUS else ego.target_lane
    parts[0] = 1.0 if ego.crashed else 0.0
    parts[1] = 1.0 if is_success(road, ego) else 0.0
    parts[2] = clip(linear_map(ego.speed, low, high, 0.0, 1.0), 0.0, 1.0)
    parts[3] = road.lanes[lane].number
    return clip(parts[1] + 0.1 * parts[2], 0.0, 1.0)
