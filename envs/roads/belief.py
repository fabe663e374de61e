"""An attacker's belief about the cars on a network of lanes, from true observations alone: rebuilt at first sight, then tracked.

An observation lacks target lanes and speeds, routes and lane-change timers. Those of the ego follow from its motion. Another car
aims for the lane where it will be soon, wants the highest speed that it has shown, and goes where most destinations are.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavbench.compiled import entry_point, inner
from cavbench.envs.highway.dynamics import wrap_to_pi
from cavbench.envs.highway.ego import IDLE, nearest_target_speed
from cavbench.envs.roads import exit_rules as leave
from cavbench.envs.roads import merge_rules as merge
from cavbench.envs.roads.bodies import put_body, put_obstacle
from cavbench.envs.roads.config import TaskKind
from cavbench.envs.roads.lanes import distance_to, heading_at, is_on, local_coordinates, position, update_lane
from cavbench.envs.roads.motion import apply_meta_action, move, update_direction
from cavbench.envs.roads.progress import way_left
from cavbench.envs.roads.replay import send_away
from cavbench.envs.roads.rows import BEHIND
from cavbench.envs.roads.simulation import advance
from cavbench.envs.roads.state import (
    Bodies,
    Body,
    Episode,
    Floats,
    Integers,
    Kind,
    Measure,
    Parameters,
    Road,
)
from cavbench.envs.roads.traffic import act, lane_distance, new_places

LOOK_AHEAD_S = 0.8
"""A car aims for the lane in which it will be after so many seconds."""
SLOW = 1.0
"""The velocity of a slower car, in m/s, does not say where it heads."""
BACKWARDS = 5.0
"""Cars do not drive backwards faster than this, in m/s: highway-env's IDM backs away from a car that stands."""
GATE = 4.0
"""A measurement farther than this in m from a predicted car belongs to another car."""
EDGE = 1.0
"""Margin in m at the borders of the view, within which a predicted car may be missing from the observation."""
CATCH_UP = 0.3
"""The share of a wrong place that changes a speed which is beyond the range of the sensor."""
STANDS = 2.5
"""A row nearer than this in m to a known obstacle is the obstacle."""
FASTER_THAN, SURELY = 0.5, 8.0
"""A car that gains so much more in m/s2 than predicted, and so many standard deviations, wants the limit of its lane."""
SURE = 1e-4
"""An action explains the ego's motion better than IDLE by at least so much, in m and m/s."""
DISCRETE, IDM, OBSTACLE = int(Kind.DISCRETE), int(Kind.IDM), int(Kind.OBSTACLE)
MERGE_CLASSIC, MERGE_GENERIC, EXIT = int(TaskKind.MERGE_CLASSIC), int(TaskKind.MERGE_GENERIC), int(TaskKind.EXIT)
WAY = int(Measure.WAY)
X, Y, SPEED, HEADING, TARGET_SPEED, TARGET_LANE, TIMER, YIELDING = range(8)
FIELDS = ("x", "y", "speed", "heading", "target_speed", "target_lane", "timer", "yielding")
"""What a belief holds of each car; the first one is the ego."""


@inner
def agreeing(road: Road, row: int, first: int, usual: int) -> int:
    """How many of the `usual` routes from the row `first` on have the roads of a route, up to the first fork."""
    place = 0
    while True:
        found = 0
        for other in range(first, first + usual):
            same = True
            for before in range(place + 1):
                same &= road.routes[other, before] == road.routes[row, before]
            found += 1 if same else 0
        if found < usual or road.routes[row, place] < 0:
            return found
        place += 1


@entry_point
def guess_routes(roads: NDArray[np.void], destinations: int, usual: int, guesses: Integers) -> None:
    """Of each lane [R, L] the route on which most of the `usual` first destinations are, then the one that turns least; or -1."""
    guesses[:] = -1
    for number in range(roads.size):
        road = roads[number]
        for own in range(road.lane_count):
            start, most = heading_at(road.lanes[own], 0.0), -np.inf
            for row in range(own * destinations, own * destinations + usual):
                last = 0
                while last + 1 < road.routes.shape[1] and road.routes[row, last + 1] >= 0:
                    last += 1
                if last == 0 and destinations > 1:
                    continue
                end = road.lanes[road.edges[road.routes[row, last]].first]
                turned = abs(wrap_to_pi(heading_at(end, end.length) - start))
                liked = 2 * np.pi * agreeing(road, row, own * destinations, usual) - turned
                if liked > most + 1e-6:
                    guesses[number, own], most = row, liked


@inner
def put_known_obstacle(road: Road, body: Body, parameters: Parameters) -> bool:
    """Put the obstacle that belongs to the road of a task, if it has one."""
    if parameters.task in (MERGE_CLASSIC, MERGE_GENERIC):
        x, y = merge.obstacle_place(road)
        put_obstacle(road, body, x, y)
        return True
    return False


@inner
def aim(road: Road, body: Body) -> None:
    """Set the target lane: of the lanes beside each other, the one where a car will be soon."""
    own = road.lanes[body.lane]
    turned = wrap_to_pi(body.heading - heading_at(own, body.along))
    x, y = position(own, body.along, body.across + LOOK_AHEAD_S * body.speed * math.sin(turned))
    edge, least = road.edges[own.edge], np.inf
    for number in range(edge.first, edge.first + edge.lanes):
        _, across = local_coordinates(road.lanes[number], x, y)
        if abs(across) < least and (number == body.lane or not road.lanes[number].forbidden):
            body.target_lane, least = number, abs(across)


@inner
def place_all(
    road: Road,
    episode: Episode,
    fields: Floats,
    own: Integers,
    guesses: Integers,
    changes_lanes: bool,
    bodies: Bodies,
    parameters: Parameters,
) -> None:
    """Put the cars of a belief [N, 8], of which the first `episode.cars` are known, on the road; `bodies` is [N + 1]."""
    for number in range(bodies.size):
        body = bodies[number]
        if number >= episode.cars:
            send_away(body, OBSTACLE)
            continue
        car = fields[number]
        put_body(road, body, parameters.ego if number == 0 else IDM, car[X], car[Y], car[HEADING], car[SPEED])
        body.target_speed, body.target_lane = car[TARGET_SPEED], int(car[TARGET_LANE])
        body.timer, body.yielding, body.changes_lanes = car[TIMER], car[YIELDING] > 0, changes_lanes
        body.route = own[body.lane] if number == 0 else guesses[body.lane]
        body.speed_index = nearest_target_speed(body.target_speed, parameters.target_speeds[: parameters.speeds])
    episode.bodies = episode.cars
    if put_known_obstacle(road, bodies[episode.cars], parameters):
        episode.bodies += 1
    if episode.cars > 0:
        episode.ahead = way_left(road, bodies[0]) if parameters.progress == WAY else bodies[0].x


@entry_point
def place_batch(
    roads: NDArray[np.void],
    episodes: NDArray[np.void],
    fields: Floats,
    own: Integers,
    guesses: Integers,
    changes_lanes: bool,
    bodies: NDArray[np.void],
    parameters: NDArray[np.void],
) -> None:
    """Put the cars of beliefs [B, N, 8] on the roads of their episodes.

    Args:
        roads, parameters: as of the engine.
        episodes: [B]; `cars` is the number of known cars.
        fields: in the order of `FIELDS`.
        own: [B, L] the route of the ego from each lane, -1 for none.
        guesses: [R, L] that of the other cars.
        changes_lanes: whether other cars change lanes.
        bodies: [B, N + 1], the output.
    """
    for row in range(episodes.size):
        episode = episodes[row]
        network = episode.network
        place_all(
            roads[network],
            episode,
            fields[row],
            own[row],
            guesses[network],
            changes_lanes,
            bodies[row],
            parameters[0],
        )


@inner
def follow_ego(
    road: Road, bodies: Bodies, row: Floats, clipped: NDArray[np.bool_], parameters: Parameters, trial: Bodies
) -> None:
    """Give the ego of the last belief the action that explains what is measured now [4]; `trial` [1] is a work array."""
    found, least, places = IDLE, np.inf, new_places(road.lane_count, 1)
    for number in range(5):
        # IDLE first: it wins a tie.
        action = (number + IDLE) % 5
        trial[:1] = bodies[:1]
        ego = trial[0]
        apply_meta_action(road, ego, action, parameters)
        for _ in range(parameters.substeps):
            act(road, trial, 1, parameters, places)
            move(road, ego, parameters.dt)
        error = abs(ego.speed * ego.cos_heading - row[2]) + abs(ego.speed * ego.sin_heading - row[3])
        error += 0.0 if clipped[0] else abs(ego.x - row[0])
        error += 0.0 if clipped[1] else abs(ego.y - row[1])
        if error < least - SURE:
            found, least = action, error
    apply_meta_action(road, bodies[0], found, parameters)


@inner
def head(body: Body, heading: float, vx: float, vy: float) -> None:
    """Set heading and signed speed from a velocity; a car that is slow, or backs away, heads about as `heading` says."""
    speed, forward = math.sqrt(vx * vx + vy * vy), vx * math.cos(heading) + vy * math.sin(heading)
    if speed < SLOW:
        body.heading, body.speed = heading, forward
    elif forward < 0.0 and speed < BACKWARDS:
        body.heading, body.speed = math.atan2(-vy, -vx), -speed
    else:
        body.heading, body.speed = math.atan2(vy, vx), speed
    update_direction(body)


@inner
def put_where_seen(road: Road, body: Body, x: float, y: float, vx: float, vy: float) -> None:
    """Set the measured part of a known car's state."""
    head(body, body.heading, vx, vy)
    body.x, body.y = x, y
    body.crashed = body.impact = False
    update_lane(body, road)


@inner
def first_sight(road: Road, body: Body, kind: int, x: float, y: float, vx: float, vy: float) -> None:
    """A car that was not known before; a slow one heads along the nearest lane."""
    heading, least = 0.0, np.inf
    for number in range(road.lane_count):
        apart = distance_to(road.lanes[number], x, y)
        if apart < least:
            along, _ = local_coordinates(road.lanes[number], x, y)
            heading, least = heading_at(road.lanes[number], along), apart
    head(body, heading, vx, vy)
    put_body(road, body, kind, x, y, body.heading, body.speed)
    aim(road, body)


@inner
def nearest_prediction(bodies: Bodies, taken: NDArray[np.bool_], count: int, x: float, y: float) -> int:
    """The predicted car that a measurement belongs to; 0 if none."""
    found, least = 0, GATE
    for number in range(1, count):
        apart = math.sqrt((bodies[number].x - x) ** 2 + (bodies[number].y - y) ** 2)
        if not taken[number] and apart < least:
            found, least = number, apart
    return found


@inner
def caught_up(predicted: float, off: float, shown: float, edge: float, period: float) -> float:
    """A component of a velocity in m/s that is beyond the upper (1) or lower edge (-1) of its range, where `shown` is.

    It follows from the motion: `off` is by how many m the predicted place was wrong.
    """
    found = predicted + CATCH_UP * off / period
    return max(found, shown) if edge > 0 else min(found, shown)


@inner
def see(
    road: Road,
    bodies: Bodies,
    episode: Episode,
    rows: Floats,
    clipped: NDArray[np.int8],
    parameters: Parameters,
    taken: NDArray[np.bool_],
    known: int,
) -> None:
    """Update the cars besides the ego from the rows [V, 5] of an observation: presence, x, y, vx, vy from the ego."""
    ego = bodies[0]
    ego_vx, ego_vy = ego.speed * ego.cos_heading, ego.speed * ego.sin_heading
    obstacle = bodies[bodies.size - 1]
    noise = SURELY * episode.noise_sigma
    has_obstacle = put_known_obstacle(road, obstacle, parameters)
    for row in range(1, rows.shape[0]):
        if rows[row, 0] <= 0.0 or clipped[row, 0] != 0 or clipped[row, 1] != 0:
            continue
        x, y = ego.x + rows[row, 1], ego.y + rows[row, 2]
        vx, vy = ego_vx + rows[row, 3], ego_vy + rows[row, 4]
        if has_obstacle and abs(x - obstacle.x) < STANDS and abs(y - obstacle.y) < STANDS and vx * vx + vy * vy < SLOW:
            continue
        number = nearest_prediction(bodies, taken, known, x, y)
        beyond = clipped[row, 2] != 0 or clipped[row, 3] != 0
        if number > 0:
            car = bodies[number]
            predicted = car.speed
            if clipped[row, 2] != 0:
                vx = caught_up(car.speed * car.cos_heading, x - car.x, vx, clipped[row, 2], parameters.period)
            if clipped[row, 3] != 0:
                vy = caught_up(car.speed * car.sin_heading, y - car.y, vy, clipped[row, 3], parameters.period)
            put_where_seen(road, car, x, y, vx, vy)
            aim(road, car)
            # Where cars give way, one that gains speed no longer has to.
            surprising = parameters.regulation == 0 and car.speed - predicted > FASTER_THAN * parameters.period + noise
            if surprising and not beyond:
                car.target_speed = max(car.target_speed, road.lanes[car.lane].speed_limit)
        elif episode.cars < bodies.size - 1:
            number = episode.cars
            car = bodies[number]
            first_sight(road, car, IDM, x, y, vx, vy)
            if beyond:
                car.speed = max(car.speed, road.lanes[car.lane].speed_limit)
            car.target_speed = car.speed
            episode.cars += 1
        else:
            continue
        taken[number] = True
        if not car.yielding:
            car.target_speed = max(car.target_speed, car.speed)


@inner
def is_hidden(road: Road, ego: Body, car: Body, episode: Episode, parameters: Parameters, farthest: float) -> bool:
    """Whether a car may be there although no row shows it: out of view, or farther along the road than the last row."""
    x, y, along = car.x - ego.x, car.y - ego.y, lane_distance(road, ego, car)
    hidden = math.sqrt(x * x + y * y) > episode.sensor_range - EDGE or along < BEHIND + EDGE
    hidden |= abs(x) > parameters.high[0] - EDGE or abs(y) > parameters.high[1] - EDGE
    hidden |= abs(along) > farthest - EDGE
    return hidden and is_on(road.lanes[car.lane], car.along, car.across, EDGE)


@inner
def forget(
    road: Road, bodies: Bodies, episode: Episode, parameters: Parameters, taken: NDArray[np.bool_], full: bool
) -> None:
    """Take out the predicted cars that should have been seen, and those that have left the road."""
    ego, farthest = bodies[0], 0.0 if full else np.inf
    for number in range(1, episode.cars):
        if full and taken[number]:
            farthest = max(farthest, abs(lane_distance(road, ego, bodies[number])))
    kept = 1
    for number in range(1, episode.cars):
        if taken[number] or is_hidden(road, ego, bodies[number], episode, parameters, farthest):
            if kept != number:
                bodies[kept : kept + 1] = bodies[number : number + 1]
            kept += 1
    episode.cars = kept


@inner
def track(
    road: Road,
    bodies: Bodies,
    episode: Episode,
    rows: Floats,
    clipped: NDArray[np.int8],
    parameters: Parameters,
    trial: Bodies,
    taken: NDArray[np.bool_],
    corners: Floats,
) -> None:
    """Update the cars of an episode's last belief, which are on the road, from what is observed one decision later."""
    x, y, vx, vy = rows[0, 1], rows[0, 2], rows[0, 3], rows[0, 4]
    known = episode.cars
    if known == 0:
        if clipped[0, 0] != 0 and parameters.task == EXIT:
            x = leave.expected_place(road)
        first_sight(road, bodies[0], parameters.ego, x, y, vx, vy)
        episode.cars = known = 1
    else:
        if parameters.ego == DISCRETE:
            follow_ego(road, bodies, rows[0, 1:], clipped[0] != 0, parameters, trial)
        advance(road, bodies[: episode.bodies], episode, parameters.substeps, parameters, corners)
        ego = bodies[0]
        put_where_seen(road, ego, ego.x if clipped[0, 0] else x, ego.y if clipped[0, 1] else y, vx, vy)
        episode.steps += 1
    ego = bodies[0]
    if known == 1 and episode.steps == 0:
        ego.speed_index = nearest_target_speed(ego.speed, parameters.target_speeds[: parameters.speeds])
        ego.target_speed = parameters.target_speeds[ego.speed_index]
    taken[:] = False
    taken[0] = True
    see(road, bodies, episode, rows, clipped, parameters, taken, known)
    full = rows[rows.shape[0] - 1, 0] > 0.0
    forget(road, bodies, episode, parameters, taken, full)


@entry_point
def track_batch(
    roads: NDArray[np.void],
    bodies: NDArray[np.void],
    episodes: NDArray[np.void],
    rows: Floats,
    clipped: NDArray[np.int8],
    parameters: NDArray[np.void],
    fields: Floats,
) -> None:
    """Update beliefs that `place_batch` has put on the roads, and write them into `fields` [B, N, 8].

    Args:
        roads, parameters: as of the engine.
        bodies, episodes: from `place_batch`; changed.
        rows: [B, V, 5] measurements in physical units: presence, x, y, vx, vy; from the second row on, from the ego.
        clipped: [B, V, 4] whether x, y, vx, vy are at the upper (1) or lower (-1) edge of their range, or neither (0).
        fields: the output.
    """
    given, corners, trial = parameters[0], np.empty((2, 5, 2)), np.empty_like(bodies[0][:1])
    taken = np.zeros(bodies.shape[1], np.bool_)
    for number in range(episodes.size):
        episode, cars = episodes[number], bodies[number]
        road = roads[episode.network]
        track(road, cars, episode, rows[number], clipped[number], given, trial, taken, corners)
        fields[number] = 0.0
        for car in range(episode.cars):
            body, place = cars[car], fields[number, car]
            place[X], place[Y], place[SPEED], place[HEADING] = body.x, body.y, body.speed, body.heading
            place[TARGET_SPEED], place[TARGET_LANE] = body.target_speed, body.target_lane
            place[TIMER], place[YIELDING] = body.timer, 1.0 if body.yielding else 0.0
