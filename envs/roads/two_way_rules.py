"""The rules of the two-way overtaking: start and reward of highway-env's envs/two_way_env.py in compiled code."""

from __future__ import annotations

from cavbench.compiled import inner
from cavbench.envs.roads.bodies import put_body
from cavbench.envs.roads.generator import Generator, next_normal
from cavbench.envs.roads.lanes import position
from cavbench.envs.roads.state import Bodies, Episode, Floats, Kind, Parameters, Road
from cavbench.envs.roads.two_way import AGAINST, WITH

EGO_PLACE, EGO_SPEED = 30.0, 30.0
IDM = int(Kind.IDM)


@inner
def put_car(
    road: Road,
    bodies: Bodies,
    episode: Episode,
    generator: Generator,
    lane: int,
    place: float,
    speed: float,
    spread: float,
    density: float,
) -> None:
    """A car about `place` m from the beginning of a lane, which never changes lanes."""
    own = road.lanes[lane]
    along = place + 10.0 / density * next_normal(generator)
    driven = speed + spread * next_normal(generator)
    x, y = position(own, along, 0.0)
    put_body(road, bodies[episode.cars], IDM, x, y, own.heading, driven)
    bodies[episode.cars].changes_lanes = False
    episode.cars += 1
    episode.bodies = episode.cars


@inner
def spawn(road: Road, bodies: Bodies, episode: Episode, generator: Generator, parameters: Parameters) -> None:
    """TwoWayEnv._make_vehicles, whose three cars are 40 m apart and whose two cars that come are 100 m apart."""
    x, y = position(road.lanes[road.spots[WITH]], EGO_PLACE, 0.0)
    put_body(road, bodies[0], parameters.ego, x, y, 0.0, EGO_SPEED)
    episode.ego, episode.cars = 0, 1
    for number in range(episode.traffic):
        place = 70.0 + 40.0 / episode.density * number
        put_car(road, bodies, episode, generator, road.spots[WITH], place, 24.0, 2.0, episode.density)
    for number in range(episode.oncoming):
        place = 200.0 + 100.0 / episode.opposing * number
        put_car(road, bodies, episode, generator, road.spots[AGAINST], place, 20.0, 5.0, episode.opposing)
        bodies[episode.cars - 1].target_lane = road.spots[AGAINST]


@inner
def reward(road: Road, bodies: Bodies, episode: Episode, parameters: Parameters, parts: Floats) -> float:
    """TwoWayEnv._reward; `parts` [2] become its `_rewards`: number of the target speed, and the lane to the left."""
    ego = bodies[episode.ego]
    others = road.edges[road.lanes[ego.lane].edge].lanes - 1
    parts[0] = ego.speed_index / (parameters.speeds - 1)
    parts[1] = (others - road.lanes[ego.target_lane].number) / max(others, 1)
    return 0.8 * parts[0] + 0.2 * parts[1]
