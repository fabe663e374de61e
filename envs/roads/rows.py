"""The ego's observation as rows: highway-env's KinematicObservation (envs/common/observation.py) behind the weather's sensor."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavbench.compiled import inner
from cavbench.envs.highway.dynamics import clip, linear_map
from cavbench.envs.highway.sensor import FEATURES, add_noise
from cavbench.envs.roads.exit import EXIT_LANE
from cavbench.envs.roads.lanes import heading_at, local_coordinates, wrap_to_pi
from cavbench.envs.roads.state import Bodies, Body, Episode, Feature, Floats, Integers, Parameters, Road, ViewKind
from cavbench.envs.roads.traffic import lane_distance

EXIT_ROWS = int(ViewKind.EXIT_ROWS)
BEHIND = -10.0
"""Bodies farther behind than this in m, along the ego's lane, are not seen: two lengths of a car."""
WIDEST_X, WIDEST_V = 200.0, 80.0
"""highway-env's default ranges of x in m and of vx, vy in m/s."""


X, Y, VX, VY, PRESENCE = (
    int(Feature.X),
    int(Feature.Y),
    int(Feature.VX),
    int(Feature.VY),
    int(Feature.PRESENCE),
)
COS_H, SIN_H, LONG_OFF, LAT_OFF = int(Feature.COS_H), int(Feature.SIN_H), int(Feature.LONG_OFF), int(Feature.LAT_OFF)


@inner
def nearest_bodies(road: Road, bodies: Bodies, episode: Episode, obstacles: bool, rows: Integers, far: Floats) -> int:
    """Road.close_objects_to: fill `rows` [V - 1] with the bodies in view, nearest along the ego's lane first; return how many.

    `far` [V - 1] is a work array for their distances.
    """
    ego = bodies[episode.ego]
    found = 0
    for number in range(episode.bodies if obstacles else episode.cars):
        other = bodies[number]
        x, y = other.x - ego.x, other.y - ego.y
        if number == episode.ego or not math.sqrt(x * x + y * y) < episode.sensor_range:
            continue
        distance = lane_distance(road, ego, other)
        if not distance > BEHIND:
            continue
        distance = abs(distance)
        slot = found
        while slot > 0 and far[slot - 1] > distance:
            if slot < rows.size:
                rows[slot], far[slot] = rows[slot - 1], far[slot - 1]
            slot -= 1
        if slot < rows.size:
            rows[slot], far[slot] = number, distance
            found = min(found + 1, rows.size)
    return found


@inner
def measure(ego: Body, other: Body, relative: bool, measured: Floats) -> None:
    """Vehicle.to_dict: x, y, vx, vy of `other` into `measured` [4], minus the ego's values if `relative`."""
    measured[0], measured[1] = other.x, other.y
    measured[2], measured[3] = other.speed * other.cos_heading, other.speed * other.sin_heading
    if relative:
        measured[0] -= ego.x
        measured[1] -= ego.y
        measured[2] -= ego.speed * ego.cos_heading
        measured[3] -= ego.speed * ego.sin_heading


@inner
def unscaled(road: Road, body: Body, feature: int) -> float:
    """A feature that highway-env does not scale."""
    if feature == PRESENCE:
        return 1.0
    if feature == COS_H:
        return body.cos_heading
    if feature == SIN_H:
        return body.sin_heading
    if feature == LONG_OFF:
        return body.along
    if feature == LAT_OFF:
        return body.across
    return wrap_to_pi(body.heading - heading_at(road.lanes[body.lane], body.along))


@inner
def write_row(
    road: Road, body: Body, episode: Episode, measured: Floats, parameters: Parameters, row: NDArray[np.float32]
) -> None:
    """KinematicObservation.normalize_obs: one row [F], mapped to [-1, 1] and clipped."""
    for place in range(parameters.columns):
        feature = parameters.features[place]
        if feature >= FEATURES:
            row[place] = unscaled(road, body, feature)
            continue
        low, high = parameters.low[feature], parameters.high[feature]
        if parameters.default_range:
            high = WIDEST_X if feature == X else episode.range_y if feature == Y else WIDEST_V
            low = -high
        value = linear_map(measured[feature], low, high, -1.0, 1.0)
        row[place] = clip(value, -1.0, 1.0) if parameters.clipped else value


@inner
def observe(
    road: Road,
    bodies: Bodies,
    episode: Episode,
    parameters: Parameters,
    rows: Integers,
    work: Floats,
    observation: NDArray[np.float32],
) -> None:
    """Fill `observation` [V, F]: the ego in absolute values, then the others nearest first, then empty rows.

    `rows` [V - 1] and `work` [V + 3] are work arrays.
    """
    ego = bodies[episode.ego]
    measured = work[:FEATURES]
    observation[:] = 0.0
    measure(ego, ego, False, measured)
    if parameters.layout == EXIT_ROWS:
        measured[0], _ = local_coordinates(road.lanes[road.spots[EXIT_LANE]], ego.x, ego.y)
    write_row(road, ego, episode, measured, parameters, observation[0])
    found = nearest_bodies(road, bodies, episode, parameters.obstacles, rows, work[FEATURES:])
    for row in range(found):
        number = rows[row]
        measure(ego, bodies[number], parameters.relative, measured)
        add_noise(measured, episode.noise_sigma, episode.seed, episode.steps, number)
        write_row(road, bodies[number], episode, measured, parameters, observation[1 + row])
