"""The ego's observation: highway-env's KinematicObservation (envs/common/observation.py) with the weather's sensor model."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavbench.compiled import inner
from cavbench.envs.highway.dynamics import VEHICLE_LENGTH, clip, linear_map
from cavbench.envs.highway.sensor import FEATURES, add_noise
from cavbench.envs.highway.state import Episode, Floats, Integers, Parameters, Vehicle, Vehicles


@inner
def is_seen(ego: Vehicle, other: Vehicle, sensor_range: float) -> bool:
    """Road.close_objects_to: whether `other` is within the sensor's range and less than two lengths behind."""
    x, y = other.x - ego.x, other.y - ego.y
    return x > -2 * VEHICLE_LENGTH and math.sqrt(x * x + y * y) < sensor_range


@inner
def nearest_vehicles(vehicles: Vehicles, order: Integers, sensor_range: float, rows: Integers) -> int:
    """Fill `rows` [V - 1] with the visible vehicles, nearest along the road first (ties: by number); return their number."""
    ego = vehicles[0]
    found = 0
    for place in range(order.size):
        number = order[place]
        distance = vehicles[number].x - ego.x
        if distance >= sensor_range:
            break
        if number == 0 or not is_seen(ego, vehicles[number], sensor_range):
            continue
        distance = abs(distance)
        slot = found
        while slot > 0:
            before = rows[slot - 1]
            gap = abs(vehicles[before].x - ego.x)
            if gap < distance or (gap == distance and before < number):
                break
            if slot < rows.size:
                rows[slot] = before
            slot -= 1
        if slot < rows.size:
            rows[slot] = number
            found = min(found + 1, rows.size)
    return found


@inner
def measure(ego: Vehicle, other: Vehicle, relative: bool, measured: Floats) -> None:
    """Vehicle.to_dict: write x, y, vx, vy of `other` into `measured` [4], minus the ego's values if `relative`."""
    measured[0] = other.x
    measured[1] = other.y
    measured[2] = other.speed * other.cos_heading
    measured[3] = other.speed * other.sin_heading
    if relative:
        measured[0] -= ego.x
        measured[1] -= ego.y
        measured[2] -= ego.speed * ego.cos_heading
        measured[3] -= ego.speed * ego.sin_heading


@inner
def write_row(measured: Floats, low: Floats, high: Floats, row: NDArray[np.float32]) -> None:
    """KinematicObservation.normalize_obs: one row [1 + 4], presence first, mapped to [-1, 1] and clipped."""
    row[0] = 1.0
    for feature in range(FEATURES):
        scaled = linear_map(measured[feature], low[feature], high[feature], -1.0, 1.0)
        row[1 + feature] = clip(scaled, -1.0, 1.0)


@inner
def observe(
    vehicles: Vehicles,
    order: Integers,
    episode: Episode,
    parameters: Parameters,
    rows: Integers,
    measured: Floats,
    observation: NDArray[np.float32],
) -> None:
    """Fill `observation` [V, 5]: the ego in absolute values, then the others relative to it, then empty rows.

    `rows` [V - 1] and `measured` [4] are work arrays.
    """
    ego = vehicles[0]
    low, high = parameters.low[episode.lanes], parameters.high[episode.lanes]
    observation[:] = 0.0
    measure(ego, ego, False, measured)
    write_row(measured, low, high, observation[0])
    found = nearest_vehicles(vehicles, order, episode.sensor_range, rows)
    for row in range(found):
        number = rows[row]
        measure(ego, vehicles[number], True, measured)
        add_noise(measured, episode.noise_sigma, episode.seed, episode.steps, number)
        write_row(measured, low, high, observation[1 + row])
