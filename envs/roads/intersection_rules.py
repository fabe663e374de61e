"""The rules of the intersection: start, arriving and leaving cars, and reward of highway-env's envs/intersection_env.py."""

from __future__ import annotations

import math

from cavbench.compiled import inner
from cavbench.envs.highway.dynamics import clip, linear_map
from cavbench.envs.roads.bodies import put_body
from cavbench.envs.roads.generator import Generator, next_double, next_normal, next_pair, next_uniform
from cavbench.envs.roads.intersection import ARRIVED, ENTRIES, EXITS
from cavbench.envs.roads.lanes import heading_at, position
from cavbench.envs.roads.simulation import advance
from cavbench.envs.roads.state import Bodies, Body, Episode, Floats, Kind, Parameters, Road

CHANCE, SPREAD_OVER = 0.6, 80.0
"""The chance of each of the cars that may be there at the start, and the length of the arm in m over which they are spread."""
SECONDS_BEFORE = 3
"""The traffic drives so long before the ego is put into it."""
ROOM, EGO_ROOM = 15.0, 20.0
"""No car is put nearer than this in m to another one; around the ego they are taken away."""
LEAVING = 20.0
"""A car is taken away so far in m before the end of its arm."""
IDM = int(Kind.IDM)


@inner
def distance(first: Body, second: Body) -> float:
    """Distance of two centres in m."""
    x, y = first.x - second.x, first.y - second.y
    return math.sqrt(x * x + y * y)


@inner
def spawn_car(
    road: Road,
    bodies: Bodies,
    episode: Episode,
    generator: Generator,
    along: float,
    spread: float,
    speed_spread: float,
    chance: float,
    go_straight: bool,
) -> None:
    """IntersectionEnv._spawn_vehicle: a car on a random arm, if there is room; a car that finds none draws no exponent."""
    if next_double(generator) > chance:
        return
    arm, goal = next_pair(generator)
    if go_straight:
        goal = (arm + 2) % 4
    lane = road.lanes[road.spots[ENTRIES + arm]]
    place = along + 5.0 + next_normal(generator) * spread
    speed = 8.0 + next_normal(generator) * speed_spread
    if episode.cars >= bodies.size:
        return
    x, y = position(lane, place, 0.0)
    car = bodies[episode.cars]
    put_body(road, car, IDM, x, y, heading_at(lane, place), speed)
    for number in range(episode.cars):
        if distance(bodies[number], car) < ROOM:
            return
    car.route = car.lane * 4 + goal
    car.delta = next_uniform(generator, 3.5, 4.5)
    episode.cars += 1
    episode.bodies = episode.cars


@inner
def remove(bodies: Bodies, episode: Episode, number: int) -> None:
    """Take a car out of the list; the others keep their order."""
    for place in range(number, episode.cars - 1):
        bodies[place : place + 1] = bodies[place + 1 : place + 2]
    episode.cars -= 1
    episode.bodies = episode.cars
    if number < episode.ego:
        episode.ego -= 1


@inner
def spawn(
    road: Road, bodies: Bodies, episode: Episode, generator: Generator, parameters: Parameters, corners: Floats
) -> None:
    """IntersectionEnv._make_vehicles."""
    episode.cars = episode.bodies = 0
    episode.ego = -1
    for number in range(episode.traffic - 1):
        along = number * (SPREAD_OVER / (episode.traffic - 1))
        spawn_car(road, bodies, episode, generator, along, 1.0, 1.0, CHANCE, False)
    frames = SECONDS_BEFORE * parameters.simulation_frequency
    advance(road, bodies[: episode.bodies], episode, frames, parameters, corners)
    spawn_car(road, bodies, episode, generator, 60.0, 0.1, 0.0, 1.0, True)
    lane = road.lanes[road.spots[ENTRIES]]
    x, y = position(lane, 60.0 + 5.0 * (1.0 + next_normal(generator)), 0.0)
    episode.ego = episode.cars
    ego = bodies[episode.ego]
    put_body(road, ego, parameters.ego, x, y, heading_at(lane, 60.0), lane.speed_limit)
    ego.route, ego.slides = ego.lane * 4 + episode.goal, parameters.slides
    episode.cars += 1
    episode.bodies = episode.cars
    number = 0
    while number < episode.cars:
        if number != episode.ego and distance(bodies[number], bodies[episode.ego]) < EGO_ROOM:
            remove(bodies, episode, number)
        else:
            number += 1


@inner
def is_exit(road: Road, body: Body) -> bool:
    """Whether a car is on a lane out of the crossing."""
    found = False
    for arm in range(4):
        found |= body.lane == road.spots[EXITS + arm]
    return found


@inner
def after_step(road: Road, bodies: Bodies, episode: Episode, generator: Generator) -> None:
    """What IntersectionEnv.step does after the observation: cars that leave are taken away, and one may come."""
    number = 0
    while number < episode.cars:
        car = bodies[number]
        leaving = is_exit(road, car) and car.along >= road.lanes[car.lane].length - LEAVING
        if number != episode.ego and leaving:
            remove(bodies, episode, number)
        else:
            number += 1
    spawn_car(road, bodies, episode, generator, 0.0, 1.0, 1.0, episode.arrivals, False)


@inner
def has_arrived(road: Road, ego: Body) -> bool:
    """IntersectionEnv.has_arrived."""
    return is_exit(road, ego) and ego.along >= ARRIVED


@inner
def reward(road: Road, ego: Body, on_road: bool, parameters: Parameters, parts: Floats) -> float:
    """IntersectionEnv._reward; `parts` [4] become its `_rewards`: collision, speed, arrival, on the road."""
    low, high = parameters.reward_speed_low, parameters.reward_speed_high
    parts[0] = 1.0 if ego.crashed else 0.0
    parts[1] = clip(linear_map(ego.speed, low, high, 0.0, 1.0), 0.0, 1.0)
    parts[2] = 1.0 if has_arrived(road, ego) else 0.0
    parts[3] = 1.0 if on_road else 0.0
    value = -5.0 * parts[0] + parts[1] + parts[2]
    return (1.0 if parts[2] > 0 else value) * parts[3]
