"""The rules of the roundabout: start and reward of highway-env's envs/roundabout_env.py in compiled code."""

from __future__ import annotations

from cavbench.compiled import inner
from cavbench.envs.highway.dynamics import linear_map
from cavbench.envs.highway.ego import LANE_LEFT, LANE_RIGHT, nearest_target_speed
from cavbench.envs.roads.bodies import is_free, put_body
from cavbench.envs.roads.generator import Generator, next_below, next_normal, next_uniform
from cavbench.envs.roads.lanes import heading_at, position
from cavbench.envs.roads.roundabout import DESTINATIONS, EAST, ENTRIES, SOUTH, WEST_INNER, WEST_OUTER
from cavbench.envs.roads.state import Bodies, Episode, Floats, Kind, Parameters, Road

EGO_PLACE, EGO_SPEED = 125.0, 8.0
SPREAD, SPEED = 2.0, 16.0
"""Standard deviation of places in m and of speeds in m/s, and the mean speed."""
ALL, GOALS = len(DESTINATIONS), 3
"""Number of destinations, and of those of the other cars."""
CARS = ((WEST_OUTER, 5.0), (WEST_INNER, 20.0), (WEST_INNER, -20.0), (EAST, 50.0))
"""Lane and place in m of highway-env's four cars."""
ARMS, ARM, ROOM, TRIES = 3, 127.5, 15.0, 10
"""More cars come from three arms of so many m; each is so far in m from all others, or left out after so many tries."""
DELTA_LOW, DELTA_HIGH = 3.5, 4.5
DISCRETE, IDM = int(Kind.DISCRETE), int(Kind.IDM)


@inner
def plan_route(road: Road, bodies: Bodies, number: int, destination: int) -> None:
    """ControlledVehicle.plan_route_to, from the car's lane to one of the network's destinations."""
    bodies[number].route, bodies[number].route_place = bodies[number].lane * ALL + destination, 0


@inner
def put_car(road: Road, bodies: Bodies, episode: Episode, generator: Generator, lane: int, place: float) -> None:
    """One of the other cars, about `place` m from the beginning of a lane, with a random speed, goal and exponent."""
    along = place + next_normal(generator) * SPREAD
    speed = SPEED + next_normal(generator) * SPREAD
    x, y = position(road.lanes[lane], along, 0.0)
    put_body(road, bodies[episode.cars], IDM, x, y, heading_at(road.lanes[lane], along), speed)
    plan_route(road, bodies, episode.cars, next_below(generator, GOALS))
    bodies[episode.cars].delta = next_uniform(generator, DELTA_LOW, DELTA_HIGH)
    episode.cars += 1


@inner
def put_on_an_arm(road: Road, bodies: Bodies, episode: Episode, generator: Generator) -> None:
    """One more car than highway-env has, on its way to the ring."""
    for _ in range(TRIES):
        lane = road.spots[ENTRIES + next_below(generator, ARMS)]
        along = next_uniform(generator, 0.0, ARM)
        x, y = position(road.lanes[lane], along, 0.0)
        if is_free(bodies, episode.cars, x, y, ROOM):
            put_car(road, bodies, episode, generator, lane, along)
            return


@inner
def spawn(road: Road, bodies: Bodies, episode: Episode, generator: Generator, parameters: Parameters) -> None:
    """RoundaboutEnv._make_vehicles."""
    lane = road.lanes[road.spots[SOUTH]]
    x, y = position(lane, EGO_PLACE, 0.0)
    put_body(road, bodies[0], parameters.ego, x, y, heading_at(lane, EGO_PLACE), EGO_SPEED)
    plan_route(road, bodies, 0, episode.goal)
    # highway-env's IDM driver may miss its exit from the inner lane.
    bodies[0].changes_lanes = False
    episode.ego, episode.cars = 0, 1
    for number in range(min(episode.traffic, len(CARS))):
        spot, place = CARS[number]
        put_car(road, bodies, episode, generator, road.spots[spot], place)
    for _ in range(len(CARS), episode.traffic):
        put_on_an_arm(road, bodies, episode, generator)
    episode.bodies = episode.cars


@inner
def reward(
    bodies: Bodies, episode: Episode, action: int, on_road: bool, parameters: Parameters, parts: Floats
) -> float:
    """RoundaboutEnv._reward; `parts` [4] become its `_rewards`: collision, speed, lane change, on the road.

    The speed is the number of the target speed over 2, the number of default target speeds less one, whatever the table is.
    """
    ego = bodies[episode.ego]
    index = ego.speed_index
    if ego.kind != DISCRETE:
        index = nearest_target_speed(ego.speed, parameters.default_speeds)
    parts[0] = 1.0 if ego.crashed else 0.0
    parts[1] = index / 2
    parts[2] = 1.0 if action in (LANE_LEFT, LANE_RIGHT) else 0.0
    parts[3] = 1.0 if on_road else 0.0
    value = -1.0 * parts[0] + 0.2 * parts[1] + -0.05 * parts[2]
    return linear_map(value, -1.0, 0.2, 0.0, 1.0) * parts[3]
