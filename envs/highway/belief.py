"""An attacker's belief about the vehicles, from true observations alone: rebuilt at first sight, then tracked.

An observation lacks target lanes, target speeds, lane-change timers and IDM exponents. They follow partly from the motion: the
ego's target lane and speed exactly, another car's target lane from its heading, and its timer once it changes lanes.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavbench.compiled import entry_point, inner
from cavbench.envs.highway.dynamics import (
    DISCRETE,
    closest_lane,
    move,
    speed_control,
    steering_control,
    update_direction,
)
from cavbench.envs.highway.ego import IDLE, apply_meta_action, nearest_target_speed
from cavbench.envs.highway.engine import advance
from cavbench.envs.highway.search import sort_by_position
from cavbench.envs.highway.spawn import DEFAULT_DELTA, TRAFFIC_SPEED_HIGH, TRAFFIC_SPEED_LOW
from cavbench.envs.highway.state import Floats, Integers, Parameters, Vehicle, Vehicles

EGO_X = 1000.0
"""Assumed position of the ego along the road in m; its true position is outside of the sensor's range."""
DEFAULT_TIMER = 0.5
"""Assumed time in s since a car last considered a lane change."""
LOOK_AHEAD = 0.8
"""A car seen for the first time is assumed to aim for the lane in which it will be after this time in s."""
GATE_X, GATE_Y = 6.0, 2.5
"""A measurement farther than this in m from a predicted car belongs to another car."""
SAME_HEADING = 1e-3
"""Differences of a heading in rad that do not contradict the predicted target lane."""
EDGE = 1.0
"""Margin in m at the borders of the view, within which a predicted car may be missing from the observation."""
BEHIND = -10.0
"""Cars farther behind than this in m are not observed."""


@inner
def copy_vehicle(source: Vehicle, target: Vehicle) -> None:
    """Copy every field of a vehicle."""
    target.x, target.y, target.heading, target.speed = source.x, source.y, source.heading, source.speed
    target.cos_heading, target.sin_heading = source.cos_heading, source.sin_heading
    target.target_speed, target.timer, target.delta = source.target_speed, source.timer, source.delta
    target.steering, target.acceleration = source.steering, source.acceleration
    target.impact_x, target.impact_y, target.impact_pair = source.impact_x, source.impact_y, source.impact_pair
    target.lane, target.target_lane, target.crashed = source.lane, source.target_lane, source.crashed
    target.held, target.ordered, target.braking = source.held, source.ordered, source.braking
    target.ordered_acceleration, target.ordered_y = source.ordered_acceleration, source.ordered_y


@inner
def place(vehicle: Vehicle, x: float, y: float, vx: float, vy: float, lanes: int) -> None:
    """Set the measured part of a vehicle's state."""
    vehicle.x, vehicle.y = x, y
    vehicle.speed = math.sqrt(vx * vx + vy * vy)
    vehicle.heading = math.atan2(vy, vx) if vy != 0.0 else 0.0
    update_direction(vehicle)
    vehicle.lane = closest_lane(x, y, vehicle.heading, lanes)
    vehicle.crashed = False
    vehicle.impact_pair = -1


@inner
def first_sight(vehicle: Vehicle, x: float, y: float, vx: float, vy: float, lanes: int, at_start: bool) -> None:
    """A car that was not known before."""
    place(vehicle, x, y, vx, vy, lanes)
    vehicle.target_lane = closest_lane(x, y + LOOK_AHEAD * vy, 0.0, lanes)
    middle = (TRAFFIC_SPEED_LOW + TRAFFIC_SPEED_HIGH) / 2
    # Every car starts at its target speed.
    vehicle.target_speed = vehicle.speed if at_start else min(max(vehicle.speed, middle), TRAFFIC_SPEED_HIGH)
    vehicle.timer, vehicle.delta = DEFAULT_TIMER, DEFAULT_DELTA
    vehicle.steering = vehicle.acceleration = 0.0


@inner
def start_ego(ego: Vehicle, measured: Floats, lanes: int, parameters: Parameters) -> None:
    """The ego at the first observation."""
    first_sight(ego, EGO_X, measured[1], measured[2], measured[3], lanes, True)
    ego.timer = 0.0
    if parameters.ego == DISCRETE:
        ego.target_speed = parameters.target_speeds[nearest_target_speed(ego.speed, parameters.target_speeds)]


@inner
def follow_ego(ego: Vehicle, measured: Floats, lanes: int, parameters: Parameters, trial: Vehicles) -> int:
    """Find the action that explains the ego's motion, and set its target lane and speed; returns the action.

    `trial` [2] is a work array.
    """
    found, least = IDLE, np.inf
    if parameters.ego == DISCRETE:
        for number in range(5):
            # IDLE first: it wins a tie.
            action = (number + IDLE) % 5
            copy_vehicle(ego, trial[0])
            apply_meta_action(trial[0], action, lanes, parameters.target_speeds)
            for _ in range(parameters.substeps):
                trial[0].steering = steering_control(trial[0], trial[0].target_lane)
                trial[0].acceleration = speed_control(trial[0])
                move(trial[0], lanes, parameters.dt)
            error = abs(trial[0].y - measured[1])
            error += abs(trial[0].speed * trial[0].cos_heading - measured[2])
            error += abs(trial[0].speed * trial[0].sin_heading - measured[3])
            if error < least - 1e-4:
                found, least = action, error
        apply_meta_action(ego, found, lanes, parameters.target_speeds)
    return found


@inner
def seen_lane(
    before: Vehicle, heading: float, expected: int, lanes: int, parameters: Parameters, trial: Vehicles
) -> int:
    """The target lane that explains a car's heading [rad] one decision later; `expected` unless another fits better."""
    found, least = expected, np.inf
    for candidate in (expected, before.lane, before.lane - 1, before.lane + 1):
        if not 0 <= candidate < lanes:
            continue
        copy_vehicle(before, trial[1])
        for _ in range(parameters.substeps):
            trial[1].steering = steering_control(trial[1], candidate)
            move(trial[1], lanes, parameters.dt)
        error = abs(trial[1].heading - heading)
        if error < least - SAME_HEADING:
            found, least = candidate, error
    return found


@inner
def nearest_prediction(vehicles: Vehicles, taken: NDArray[np.bool_], count: int, x: float, y: float) -> int:
    """The predicted car that a measurement belongs to; 0 if none."""
    found, least = 0, np.inf
    for number in range(1, count):
        off_x, off_y = abs(vehicles[number].x - x), abs(vehicles[number].y - y)
        if not taken[number] and off_x < GATE_X and off_y < GATE_Y and off_x + off_y < least:
            found, least = number, off_x + off_y
    return found


@inner
def track(
    cars: NDArray[np.void],
    count: int,
    rows: NDArray[np.float64],
    clipped: NDArray[np.bool_],
    lanes: int,
    sensor_range: float,
    parameters: Parameters,
    before: NDArray[np.void],
    trial: NDArray[np.void],
    taken: NDArray[np.bool_],
    order: Integers,
    places: Integers,
    corners: Floats,
) -> int:
    """Update the cars of one episode from its rows of measurements [V, 5]; returns the number of known cars."""
    at_start = count == 0
    if at_start:
        start_ego(cars[0], rows[0, 1:], lanes, parameters)
        count = 1
    else:
        follow_ego(cars[0], rows[0, 1:], lanes, parameters, trial)
        for number in range(count):
            copy_vehicle(cars[number], before[number])
            order[number] = number
        sort_by_position(cars, order[:count])
        advance(cars[:count], order[:count], places[:count], corners, lanes, parameters)
        shift = EGO_X - cars[0].x
        for number in range(count):
            cars[number].x += shift
        lane, speed = cars[0].target_lane, cars[0].target_speed
        place(cars[0], EGO_X, rows[0, 2], rows[0, 3], rows[0, 4], lanes)
        cars[0].target_lane, cars[0].target_speed = lane, speed
    taken[:] = False
    taken[0] = True
    known, farthest, full = count, 0.0, True
    for row in range(1, rows.shape[0]):
        if rows[row, 0] <= 0.0:
            full = False
            continue
        farthest = max(farthest, abs(rows[row, 1]))
        if clipped[row]:
            continue
        x, y = EGO_X + rows[row, 1], cars[0].y + rows[row, 2]
        vx, vy = rows[0, 3] + rows[row, 3], rows[0, 4] + rows[row, 4]
        number = nearest_prediction(cars, taken, known, x, y)
        if number == 0:
            if count < cars.size:
                first_sight(cars[count], x, y, vx, vy, lanes, at_start)
                taken[count] = True
                count += 1
            continue
        taken[number] = True
        car = cars[number]
        lane = seen_lane(before[number], math.atan2(vy, vx), car.target_lane, lanes, parameters, trial)
        place(car, x, y, vx, vy, lanes)
        if lane != car.target_lane:
            if lane != before[number].lane:
                # It decided in this period.
                car.timer = parameters.substeps * parameters.dt
            car.target_lane = lane
    # A predicted car that should have been seen is not there.
    kept = 1
    for number in range(1, count):
        ahead = cars[number].x - EGO_X
        hidden = ahead < BEHIND + EDGE or ahead > sensor_range - EDGE or (full and abs(ahead) > farthest - EDGE)
        if taken[number] or hidden:
            if kept != number:
                copy_vehicle(cars[number], cars[kept])
            kept += 1
    return kept


@entry_point
def track_batch(
    cars: NDArray[np.void],
    counts: Integers,
    rows: NDArray[np.float64],
    clipped: NDArray[np.bool_],
    lanes: Integers,
    sensor_range: Floats,
    parameters: Parameters,
) -> None:
    """Update the beliefs `cars` [B, N] and `counts` [B] from measurements [B, V, 5] in physical units.

    `lanes` and `sensor_range` [m] are those of each episode [B].
    """
    size = cars.shape[1]
    before, trial = np.empty_like(cars[0]), np.empty_like(cars[0])
    taken = np.zeros(size, np.bool_)
    order, places = np.empty(size, np.int64), np.empty(size, np.int64)
    corners = np.empty((2, 5, 2))
    for episode in range(cars.shape[0]):
        counts[episode] = track(
            cars[episode],
            counts[episode],
            rows[episode],
            clipped[episode],
            lanes[episode],
            sensor_range[episode],
            parameters,
            before,
            trial,
            taken,
            order,
            places,
            corners,
        )
