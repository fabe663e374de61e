"""Compiled loops over the episodes: where the ego is after a decision, and where the other cars may be. float32 throughout."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavbench.compiled import entry_point, inner
from cavbench.driving.intervals.kernels import Flags, Floats

Y, HEADING, SPEED, LANE, TARGET, EDGE, KNOWN = range(7)
"""The fields of `cavbench.driving.intervals.ego.Ego`, and, of a state, whether they are known."""


SLACK = 1.0
"""The reckoned place and speed are corrected if they are farther outside of the measured box than this, in m and m/s."""
OFF_THE_ROAD = 0.3
"""A lane does not exist if the measured place stays this far to the left of the reckoned one, in m."""
UNKNOWN_EDGE = 64
"""The rightmost lane, as long as the car has not found it by steering towards a lane that does not exist."""


class Car(NamedTuple):
    """The ego's kinematics (`cavbench.driving.kinematics.Kinematics`), float32 but for the counts.

    Args:
        frames: physics frames per decision.
        last: number of the highest target speed.
        dt: seconds per frame.
        half_length: half the length of a car, in m.
        start_speed: as there; NaN if the ego starts at any.
        lane_width, top_speed, speed_gain, heading_gain, lateral_gain, max_heading, max_steering: as there.
        acceleration_limit, steering_limit: as there.
        lowest, range: the lowest target speed, and the highest less the lowest, in m/s.
        spacing: from one target speed to the next, in m/s.
    """

    frames: int
    last: int
    dt: np.float32
    half_length: np.float32
    start_speed: np.float32
    lane_width: np.float32
    top_speed: np.float32
    speed_gain: np.float32
    heading_gain: np.float32
    lateral_gain: np.float32
    max_heading: np.float32
    max_steering: np.float32
    acceleration_limit: np.float32
    steering_limit: np.float32
    lowest: np.float32
    range: np.float32
    spacing: np.float32


@inner
def clamped(value: np.float32, low: np.float32, high: np.float32) -> np.float32:
    """`torch.clamp`: between the bounds, of which the upper one wins; NaN stays."""
    value = low if value < low else value
    return high if value > high else value


@inner
def _steering(ego: Floats, car: Car) -> np.float32:
    """ControlledVehicle.steering_control towards the middle of the target lane, in rad."""
    one, speed = np.float32(1), max(ego[SPEED], np.float32(0.01))
    lateral = ego[Y] - car.lane_width * ego[LANE]
    wanted = np.arcsin(clamped(-car.lateral_gain * lateral / speed, -one, one))
    wanted = clamped(wanted, -car.max_heading, car.max_heading)
    rate = car.heading_gain * (wanted - ego[HEADING])
    slip = np.arcsin(clamped(car.half_length / speed * rate, -one, one))
    return clamped(np.arctan(np.float32(2) * np.tan(slip)), -car.max_steering, car.max_steering)


@inner
def _move(ego: Floats, acceleration: np.float32, steering: np.float32, car: Car) -> None:
    """Vehicle.step: one frame of the kinematic bicycle model."""
    excess, speed, heading = ego[SPEED] - car.top_speed, ego[SPEED], ego[HEADING]
    if excess > 0:
        acceleration = min(acceleration, -excess)
    slip = np.arctan(np.float32(0.5) * np.tan(steering))
    ego[Y] += speed * np.sin(heading + slip) * car.dt
    ego[HEADING] = heading + speed * np.sin(slip) / car.half_length * car.dt
    ego[SPEED] = speed + acceleration * car.dt


@inner
def _middle(low: np.float32, high: np.float32) -> np.float32:
    """The middle of an interval; of one that is open at an end, the other end."""
    two = np.float32(2)
    return (low if np.isfinite(low) else high) / two + (high if np.isfinite(high) else low) / two


@inner
def _middle_slopes(low: np.float32, high: np.float32, slopes: Floats) -> None:
    """The slopes of `_middle` in both ends, [2]."""
    half = np.float32(0.5)
    slopes[:] = np.float32(0)
    slopes[0 if np.isfinite(low) else 1] += half
    slopes[1 if np.isfinite(high) else 0] += half


@inner
def _nearest_target(speed: np.float32, car: Car) -> np.float32:
    """The target speed next to a speed; the lower one of two."""
    nearest = car.lowest
    for number in range(1, car.last + 1):
        target = car.lowest + np.float32(number) * car.spacing
        nearest = target if abs(speed - target) < abs(speed - nearest) else nearest
    return nearest


@inner
def corrected(ego: Floats, low: Floats, high: Floats, car: Car, now: Floats, turned: Floats, slopes: Floats) -> None:
    """`DeadReckoning.now`: fills `now` [6] and `slopes`.

    Args:
        ego: the predicted ego, a state [7].
        low, high: the box of the measured row, [4].
        car: the kinematics.
        now: the ego.
        turned: cosine and sine of the predicted heading; changed where the heading is.
        slopes: of y in the bounds of y, then of the speed in those of vx, [4].
    """
    zero, one = np.float32(0), np.float32(1)
    slack, off, edge = np.float32(SLACK), np.float32(OFF_THE_ROAD), np.float32(UNKNOWN_EDGE)
    below, above = low[1], high[1]
    now[:], slopes[:] = ego[:KNOWN], zero
    if not ego[KNOWN] > zero:
        middle = _middle(below, above)
        first = np.rint(middle / car.lane_width)
        first = zero if first < zero else first
        now[LANE], now[EDGE] = first, edge
        if np.isfinite(car.start_speed):
            now[Y], now[SPEED], now[TARGET] = first * car.lane_width, car.start_speed, car.start_speed
            return
        now[Y], now[SPEED] = middle, _middle(low[2], high[2])
        now[TARGET] = _nearest_target(now[SPEED], car)
        _middle_slopes(below, above, slopes[:2])
        _middle_slopes(low[2], high[2], slopes[2:])
        return
    least, most = low[2] - slack, high[2] + slack
    along, forward = ego[SPEED] * turned[0], turned[0] if turned[0] > np.float32(0.1) else np.float32(0.1)
    now[SPEED] = clamped(along, least, most) / forward
    slopes[2] = one / forward if along < least < most else zero
    slopes[3] = one / forward if along > most or most < least else zero
    if ego[Y] > above + off and ego[LANE] * car.lane_width > above:
        now[EDGE] = ego[LANE] - one
        now[Y], now[HEADING], turned[0], turned[1] = now[EDGE] * car.lane_width, zero, one, zero
    else:
        left, right = below - slack, above + slack
        now[Y] = clamped(ego[Y], left, right)
        slopes[0] = one if ego[Y] < left < right else zero
        slopes[1] = one if ego[Y] > right or right < left else zero
    now[LANE] = now[EDGE] if now[EDGE] < ego[LANE] else ego[LANE]


@entry_point
def reckon(predicted: Floats, turned: Floats, low: Floats, high: Floats, car: Car, egos: Floats) -> None:
    """The egos at an observation; fills `egos` [N, 6].

    Args:
        predicted: the predicted egos, states [N, 7].
        turned: cosine and sine of their headings, [N, 2]; changed where a heading is.
        low, high: the boxes, [N, V, 4], of which the ego's is read.
        car: the kinematics.
    """
    slopes = np.empty(4, np.float32)
    for n in range(len(egos)):
        corrected(predicted[n], low[n, 0], high[n, 0], car, egos[n], turned[n], slopes)


@entry_point
def driven(egos: Floats, orders: NDArray[np.int64], turns: NDArray[np.int64], car: Car) -> None:
    """The egos [N, 6] one decision later, in place, after discrete actions.

    Args:
        egos: in the order of `Y`, `HEADING` and so on.
        orders: 1 for FASTER, -1 for SLOWER, 0 for another action, [N].
        turns: 1 for LANE_RIGHT, -1 for LANE_LEFT, 0 for another action, [N].
        car: the kinematics.
    """
    top = np.float32(car.last)
    for n in range(len(egos)):
        ego = egos[n]
        if orders[n] != 0:
            index = np.rint((ego[SPEED] - car.lowest) / car.range * top)
            index = clamped(index, np.float32(0), top) + np.float32(orders[n])
            ego[TARGET] = car.lowest + clamped(index, np.float32(0), top) * car.spacing
        lane = min(max(ego[LANE] + np.float32(turns[n]), np.float32(0)), ego[EDGE])
        # A lane farther away than two lane widths cannot be chosen (highway-env's AbstractLane.is_reachable_from).
        if np.abs(ego[Y] - car.lane_width * lane) <= np.float32(2) * car.lane_width:
            ego[LANE] = lane
        for _ in range(car.frames):
            _move(ego, car.speed_gain * (ego[TARGET] - ego[SPEED]), _steering(ego, car), car)


@entry_point
def steered(egos: Floats, controls: Floats, car: Car) -> None:
    """The egos [N, 6] one decision later, in place, after acceleration and steering `controls` [N, 2] in [-1, 1]."""
    one = np.float32(1)
    for n in range(len(egos)):
        acceleration = clamped(controls[n, 0], -one, one) * car.acceleration_limit
        steering = clamped(controls[n, 1], -one, one) * car.steering_limit
        for _ in range(car.frames):
            _move(egos[n], acceleration, steering, car)
        lane = max(np.rint(egos[n, Y] / car.lane_width), np.float32(0))
        egos[n, LANE] = min(lane, egos[n, EDGE])


Motion = tuple[np.float32, np.float32, np.float32, np.float32, np.float32]
"""Bounds of x, of vx, and how fast a car may slip sideways."""


class Limits(NamedTuple):
    """How a car may move (`cavbench.driving.intervals.tracks`); float32.

    Args:
        period: seconds per decision.
        gained, turned: largest change of the speed along and across its direction in a decision, in m/s.
        slipping: half a car's length times the largest acceleration across, in m2/s2.
        largest_slip: sine of the largest angle between where it points and where it moves.
        rounding: by how much the boxes are wider on every side.
        oncoming: whether a car may come towards the ego.
    """

    period: np.float32
    gained: np.float32
    turned: np.float32
    slipping: np.float32
    largest_slip: np.float32
    rounding: np.float32
    oncoming: bool


@inner
def _forward(
    x_low: np.float32,
    x_high: np.float32,
    vx_low: np.float32,
    vx_high: np.float32,
    vy_low: np.float32,
    vy_high: np.float32,
    of: Limits,
) -> Motion:
    """One decision later: bounds of x and vx of a car that does not drive backwards, and how far it may slip sideways, in m/s."""
    zero, one = np.float32(0), np.float32(1)
    across = max(-vy_low, vy_high)
    slowest = np.hypot(max(vx_low, zero), max(max(vy_low, -vy_high), zero))
    fastest = np.hypot(vx_high, across) + of.gained
    least = max(slowest, np.float32(0.1))
    slip = min(of.slipping / (least * least), of.largest_slip)
    across += of.turned
    kept = max(slowest - of.gained, zero)
    vx = np.sqrt(max(kept * kept - across * across, zero))
    x_low += (vx * np.sqrt(one - slip * slip) - across * slip) * of.period
    x_high += fastest * of.period
    return x_low, x_high, vx, fastest, fastest * slip


@inner
def _hull(one: Motion, other: Motion) -> Motion:
    return (
        min(one[0], other[0]),
        max(one[1], other[1]),
        min(one[2], other[2]),
        max(one[3], other[3]),
        max(one[4], other[4]),
    )


@entry_point
def later(present: Flags, low: Floats, high: Floats, before: Floats, after: Floats, of: Limits, tracks: Floats) -> None:
    """The boxes of the other cars one decision later, relative to the ego; fills `tracks` [N, V - 1, 9].

    Args:
        present: the rows that are cars, [N, V].
        low, high: the boxes now, [N, V, 4]; the ego's own is not read.
        before, after: the egos now and then, [N, 6] or states [N, 7].
        of: the limits.
        tracks: 1 for a car, else 0, the lower bounds and the upper ones: of x relative to the ego, and of y, vx and vy
            relative to its own.
    """
    zero, one = np.float32(0), np.float32(1)
    for n in range(len(low)):
        speed, cos, sin = before[n, SPEED], np.cos(before[n, HEADING]), np.sin(before[n, HEADING])
        own_y, own_vx, own_vy = before[n, Y], speed * cos, speed * sin
        driven_x = (speed + after[n, SPEED]) / np.float32(2) * cos * of.period
        then_y = after[n, Y]
        then_vx, then_vy = after[n, SPEED] * np.cos(after[n, HEADING]), after[n, SPEED] * np.sin(after[n, HEADING])
        for c in range(tracks.shape[1]):
            track = tracks[n, c]
            track[0] = one if present[n, c + 1] else zero
            x_low, y_low = low[n, c + 1, 0], low[n, c + 1, 1] + own_y
            x_high, y_high = high[n, c + 1, 0], high[n, c + 1, 1] + own_y
            vx_low, vy_low = low[n, c + 1, 2] + own_vx, low[n, c + 1, 3] + own_vy
            vx_high, vy_high = high[n, c + 1, 2] + own_vx, high[n, c + 1, 3] + own_vy
            found = _forward(x_low, x_high, vx_low, vx_high, vy_low, vy_high, of)
            if of.oncoming and vx_low < zero:
                back = _forward(-x_high, -x_low, -vx_high, -vx_low, vy_low, vy_high, of)
                mirrored = -back[1], -back[0], -back[3], -back[2], back[4]
                found = mirrored if vx_high <= zero else _hull(found, mirrored)
            x_low, x_high, vx, fastest, aside = found
            vy_low, vy_high = vy_low - of.turned, vy_high + of.turned
            y_low += (vy_low - aside) * of.period
            y_high += (vy_high + aside) * of.period
            track[1] = x_low - driven_x - of.rounding
            track[2] = y_low - then_y - of.rounding
            track[3] = vx - then_vx - of.rounding
            track[4] = vy_low - then_vy - of.rounding
            track[5] = x_high - driven_x + of.rounding
            track[6] = y_high - then_y + of.rounding
            track[7] = fastest - then_vx + of.rounding
            track[8] = vy_high - then_vy + of.rounding
