"""The rules of the merge: start and reward of highway-env's envs/merge_env.py in compiled code."""

from __future__ import annotations

from cavbench.compiled import inner
from cavbench.envs.highway.dynamics import linear_map
from cavbench.envs.highway.ego import LANE_LEFT, LANE_RIGHT
from cavbench.envs.roads.bodies import put_body, put_obstacle
from cavbench.envs.roads.generator import Generator, next_below, next_uniform
from cavbench.envs.roads.lanes import position
from cavbench.envs.roads.merge import FIRST, MERGING, RAMP
from cavbench.envs.roads.network import WIDTH
from cavbench.envs.roads.state import Bodies, Episode, Floats, Kind, Parameters, Road

EGO_PLACE, EGO_SPEED, RAMP_SPEED = 30.0, 30.0, 20.0
CLASSIC_RAMP_PLACE, GENERIC_RAMP_PLACE = 110.0, 60.0
CLASSIC_PLACES, CLASSIC_SPEEDS = (90.0, 70.0, 5.0), (29.0, 31.0, 31.5)
SAFE_DISTANCE, TRIES = 15.0, 10
"""`generic` places a car so far in m from all others of its lane, or gives it up after so many tries."""
RAMP_TARGET = 30.0
"""Target speed in m/s of the car on the ramp."""
CONTINUOUS, IDM = int(Kind.CONTINUOUS), int(Kind.IDM)


@inner
def obstacle_place(road: Road) -> tuple[float, float]:
    """Where the obstacle is, at the end of the ramp."""
    edge = road.edges[road.lanes[road.spots[FIRST]].edge + 1]
    end = road.lanes[edge.first + edge.lanes - 1]
    return position(end, end.length, 0.0)


@inner
def put_ramp(road: Road, bodies: Bodies, episode: Episode, place: float) -> None:
    """The car on the ramp, `place` m from its beginning, and the obstacle at the end of the ramp."""
    x, y = position(road.lanes[road.spots[RAMP]], place, 0.0)
    put_body(road, bodies[episode.cars], IDM, x, y, 0.0, RAMP_SPEED)
    bodies[episode.cars].target_speed = RAMP_TARGET
    episode.cars += 1
    x, y = obstacle_place(road)
    put_obstacle(road, bodies[episode.cars], x, y)
    episode.bodies = episode.cars + 1


@inner
def spawn_classic(road: Road, bodies: Bodies, episode: Episode, generator: Generator, parameters: Parameters) -> None:
    """MergeEnv._make_vehicles."""
    x, y = position(road.lanes[road.spots[FIRST] + 1], EGO_PLACE, 0.0)
    put_body(road, bodies[0], parameters.ego, x, y, 0.0, EGO_SPEED)
    episode.ego, episode.cars = 0, 1
    for number in range(3):
        lane = road.lanes[road.spots[FIRST] + next_below(generator, 2)]
        x, y = position(lane, CLASSIC_PLACES[number] + next_uniform(generator, -5.0, 5.0), 0.0)
        speed = CLASSIC_SPEEDS[number] + next_uniform(generator, -1.0, 1.0)
        put_body(road, bodies[episode.cars], IDM, x, y, 0.0, speed)
        episode.cars += 1
    put_ramp(road, bodies, episode, CLASSIC_RAMP_PLACE)


@inner
def is_free(bodies: Bodies, cars: int, along: float, y: float) -> bool:
    """Whether no car of the lane at `y` is within `SAFE_DISTANCE` of a place."""
    free = True
    for number in range(cars):
        free &= bodies[number].y != y or abs(along - bodies[number].x) > SAFE_DISTANCE
    return free


@inner
def spawn_generic(road: Road, bodies: Bodies, episode: Episode, generator: Generator, parameters: Parameters) -> None:
    """MergeGenericEnv._make_vehicles; a car that finds no room is left out."""
    first = road.edges[road.lanes[road.spots[FIRST]].edge]
    parallel = road.lanes[road.edges[road.lanes[road.spots[FIRST]].edge + 1].first]
    farthest = parallel.start_x + parallel.length
    x, y = position(road.lanes[road.spots[FIRST] + first.lanes - 1], EGO_PLACE, 0.0)
    put_body(road, bodies[0], parameters.ego, x, y, 0.0, EGO_SPEED)
    episode.ego, episode.cars = 0, 1
    for _ in range(episode.traffic):
        for _ in range(TRIES):
            lane = next_below(generator, first.lanes)
            along = next_uniform(generator, 0.0, farthest)
            if is_free(bodies, episode.cars, along, lane * WIDTH):
                x, y = position(road.lanes[road.spots[FIRST] + lane], along, 0.0)
                speed = 30.0 + next_uniform(generator, -2.0, 2.0)
                put_body(road, bodies[episode.cars], IDM, x, y, 0.0, speed)
                episode.cars += 1
                break
    put_ramp(road, bodies, episode, GENERIC_RAMP_PLACE)


@inner
def reward(road: Road, bodies: Bodies, episode: Episode, action: int, parameters: Parameters, parts: Floats) -> float:
    """MergeEnv._reward; `parts` [5] become its `_rewards`: collision, right lane, speed, lane change, slow merging cars."""
    ego = bodies[episode.ego]
    low, high = parameters.reward_speed_low, parameters.reward_speed_high
    parts[0] = 1.0 if ego.crashed else 0.0
    parts[1] = road.lanes[ego.lane].number / 1
    parts[2] = linear_map(ego.speed, low, high, 0.0, 1.0)
    parts[3] = 1.0 if action in (LANE_LEFT, LANE_RIGHT) else 0.0
    parts[4] = 0.0
    for number in range(episode.cars):
        car = bodies[number]
        if car.lane == road.spots[MERGING] and car.kind != CONTINUOUS:
            parts[4] += (car.target_speed - car.speed) / car.target_speed
    value = -1.0 * parts[0] + 0.1 * parts[1] + 0.2 * parts[2] + -0.05 * parts[3] + -0.5 * parts[4]
    return linear_map(value, -1.0 + -0.5, 0.2 + 0.1, 0.0, 1.0)
