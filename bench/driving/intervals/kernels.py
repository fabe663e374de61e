"""Compiled loops over the cars of each episode, with their gradients. Many small tensor operations take ten times as long."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavbench.compiled import entry_point, inner

FREE = 200.0
"""The room where there is no car, in m."""
FASTEST, STEP = 40.0, 0.5
"""Largest speed and resolution of a table of following distances, in m/s."""
HARDEST = 6
"""Hardest braking of a leader in a table, in m/s2."""
LEVELS_PER_UNIT = 4
"""Levels of a leader's braking in a table for each m/s2."""
DRIFT_S, DEAD_BAND = 0.6, 0.5
"""A car may be as far to the side as it gets in this time in s with the part of its lateral speed above this, in m/s."""
CLEARANCE = 0.4
"""Lateral room between two cars, in m, below which they are in the same lane."""
REAR_S, REAR_BRAKING = 0.27, 6.0
"""A car behind reacts after this time in s, when the ego has moved a metre towards its lane, and brakes at this rate in m/s2."""
SIDES = (-4, -3, -2, -1, 0, 1, 2, 3, 4)
"""The lanes whose speeds are computed, relative to the ego's target lane."""
ROOM, HORIZON_S = 12.0, 3.0
"""Room to a car ahead that does not count as free, in m, and the time in which the free room counts as speed."""
NOBODY = -1

Floats = NDArray[np.float32]
Numbers = NDArray[np.int8]
Flags = NDArray[np.bool_]


class Rules(NamedTuple):
    """What rooms depend on besides the cars. SI units.

    Args:
        period: seconds per decision.
        length: of a car, and the distance that is always kept.
        width: of a car, and `CLEARANCE`.
        lane_width: of a lane.
        braking: least rate at which a car ahead may brake.
        acceleration, jam_distance, time_gap, free_share: of the car-following model, `cavbench.driving.kinematics.CarFollowing`.
        scale: the divisor in its desired gap.
        steady: number of the option that keeps the speed.
        delay: time constant in s with which the ego slows down.
        meeting: seconds for which a car that comes towards the ego counts, for each table; 0 where the world has none, [T].
    """

    period: float
    length: float
    width: float
    lane_width: float
    braking: float
    acceleration: float
    jam_distance: float
    time_gap: float
    free_share: float
    scale: float
    steady: int
    delay: float
    meeting: Floats


@inner
def _middle(low: float, high: float) -> float:
    """The middle of an interval; where one bound is infinite, the other one; 0 where both are."""
    if np.isinf(low):
        return 0.0 if np.isinf(high) else high
    return low if np.isinf(high) else (low + high) / 2


@entry_point
def used(table: Floats, side: int, own: float, leader: float, level: int) -> tuple[float, float, float]:
    """The following distance in a table [levels * side * side], and its slopes in both speeds."""
    top = FASTEST - 1e-3
    first, second = min(max(own, 0.0), top) / STEP, min(max(leader, 0.0), top) / STEP
    row, column = int(first), int(second)
    down, right = first - row, second - column
    place = (level * side + row) * side + column
    a, b, c, d = table[place], table[place + 1], table[place + side], table[place + side + 1]
    upper, lower = a + (b - a) * right, c + (d - c) * right
    slope_own = (lower - upper) / STEP if 0 <= own <= top else 0.0
    slope_leader = ((b - a) * (1 - down) + (d - c) * down) / STEP if 0 <= leader <= top else 0.0
    return upper + (lower - upper) * down, slope_own, slope_leader


@inner
def _level(low: Floats, high: Floats, present: Flags, car: int, rules: Rules) -> int:
    """How hard a car brakes for the next one ahead of it, by its car-following model, rounded up to a level of the tables."""
    place, speed, rate = _middle(low[car, 0], high[car, 0]), _middle(low[car, 2], high[car, 2]), 0.0
    for other in range(len(low)):
        gap = _middle(low[other, 0], high[other, 0]) - place
        if not present[other] or gap <= 0:
            continue
        if low[other, 1] < high[car, 1] + rules.width and high[other, 1] > low[car, 1] - rules.width:
            closing = speed - _middle(low[other, 2], high[other, 2])
            wanted = max(rules.jam_distance + rules.time_gap * speed + speed * closing / rules.scale, 0.0)
            share = wanted / max(gap, 1.0)
            rate = max(rate, rules.acceleration * (share * share - rules.free_share))
    return int(np.ceil(min(max(rate, rules.braking), float(HARDEST)) * LEVELS_PER_UNIT))


@inner
def _spread(low: Floats, high: Floats) -> tuple[float, float]:
    """How far to the left and to the right a car may be, now or soon."""
    return low[1] + min(low[3] + DEAD_BAND, 0.0) * DRIFT_S, high[1] + max(high[3] - DEAD_BAND, 0.0) * DRIFT_S


@inner
def _overlap(left: float, right: float, middle: float, width: float) -> bool:
    """Whether a car between `left` and `right` may be in the lane around `middle`."""
    return right > middle - width and left < middle + width


@inner
def _lost(closing: float, slowing: float, rules: Rules) -> tuple[float, float]:
    """What the ego loses in m to a car that comes nearer at `closing` m/s from behind, at least 0, and its slope in `closing`.

    The ego slows down by d = `slowing` m/s with the time constant T = `delay`; the car keeps its speed for s = `REAR_S`, then
    brakes at a = `REAR_BRAKING`. With c = d + closing they are equally fast at about t = s + c / a; by then the ego has lost
    c s + c^2 / 2a - d T (1 - exp(-t / T)).
    """
    faster = slowing + max(closing, 0.0)
    left = slowing * np.exp(-(REAR_S + faster / REAR_BRAKING) / rules.delay) if slowing > 0 else 0.0
    lost = faster * (REAR_S + faster / (2 * REAR_BRAKING)) - rules.delay * (slowing - left)
    return max(lost, 0.0), (REAR_S + (faster - left) / REAR_BRAKING if closing > 0 and lost > 0 else 0.0)


@entry_point
def rooms(
    low: Floats,
    high: Floats,
    present: Flags,
    along: Floats,
    lane: Floats,
    own: Floats,
    slowing: Floats,
    tables: Floats,
    side: int,
    asked: Flags,
    rules: Rules,
    front: Floats,
    front_car: Numbers,
    rear: Floats,
    rear_car: Numbers,
    level: Numbers,
) -> None:
    """The least room to the cars ahead and behind, on the lanes to the left, own and right; fills `front`, `rear` and the cars.

    Args:
        low, high: bounds in the road's frame (x relative to the ego), [N, C, 4].
        present: [N, C].
        along: the ego's speed along the road, [N].
        lane: middle of the ego's target lane, in m, [N].
        own: the ego's speed after each option, [N, O].
        slowing: by how much the ego slows down after that, in m/s, at least 0, [N, O].
        tables: following distances [T, levels * side * side].
        side: number of speeds in a table.
        asked: the pairs of table and option whose room is computed, [N, T, O], or [1, T, O] for all points.
        rules: see `Rules`.
        front, front_car: room [N, T, 3, O] from -`FREE` to `FREE`, and the car that limits it or `NOBODY`.
        rear, rear_car: the same of the cars behind, [N, 3, O].
        level: how hard each car ahead brakes, [N, C]; needed for the gradient.
    """
    options = own.shape[1]
    for n in range(len(low)):
        which = n if len(asked) > 1 else 0
        front[n], front_car[n], rear[n], rear_car[n] = FREE, NOBODY, FREE, NOBODY
        for car in range(low.shape[1]):
            if not present[n, car]:
                continue
            left, right = _spread(low[n, car], high[n, car])
            nearest = lane[n] - rules.lane_width
            if right <= nearest - rules.width or left >= nearest + 2 * rules.lane_width + rules.width:
                continue
            ahead = low[n, car, 0] + high[n, car, 0] > 0
            if ahead:
                leader = max(low[n, car, 2], 0.0)
                gap = low[n, car, 0] + (leader - along[n]) * rules.period - rules.length
                level[n, car] = _level(low[n], high[n], present[n], car, rules)
                for table in range(len(tables)):
                    for option in range(options):
                        if not asked[which, table, option]:
                            continue
                        room = gap - used(tables[table], side, own[n, option], leader, level[n, car])[0]
                        if rules.meeting[table] > 0 and low[n, car, 2] < 0:
                            room += low[n, car, 2] * rules.meeting[table]
                        for beside in range(3):
                            middle = nearest + beside * rules.lane_width
                            if _overlap(left, right, middle, rules.width) and room < front[n, table, beside, option]:
                                front[n, table, beside, option] = room
                                front_car[n, table, beside, option] = car
            else:
                closing = high[n, car, 2] - own[n, rules.steady]
                lost = 0.0
                for option in range(options):
                    if option == 0 or slowing[n, option] != slowing[n, option - 1]:
                        lost = _lost(closing, slowing[n, option], rules)[0]
                    room = -high[n, car, 0] - rules.length - lost
                    for beside in range(3):
                        middle = nearest + beside * rules.lane_width
                        if _overlap(left, right, middle, rules.width) and room < rear[n, beside, option]:
                            rear[n, beside, option], rear_car[n, beside, option] = room, car
        for beside in range(3):
            for option in range(options):
                if rear[n, beside, option] < -FREE:
                    rear[n, beside, option], rear_car[n, beside, option] = -FREE, NOBODY
                for table in range(len(tables)):
                    if front[n, table, beside, option] < -FREE:
                        front[n, table, beside, option], front_car[n, table, beside, option] = -FREE, NOBODY


@entry_point
def rooms_backward(
    low: Floats,
    high: Floats,
    along: Floats,
    own: Floats,
    slowing: Floats,
    tables: Floats,
    side: int,
    rules: Rules,
    front_car: Numbers,
    rear_car: Numbers,
    level: Numbers,
    by_front: Floats,
    by_rear: Floats,
    by_low: Floats,
    by_high: Floats,
    by_along: Floats,
    by_own: Floats,
) -> None:
    """The gradients in the bounds and the ego's speeds, added to `by_low`, `by_high`, `by_along` and `by_own`.

    Args:
        low, high, along, own, slowing, tables, side, rules, front_car, rear_car, level: as in `rooms`.
        by_front, by_rear: gradients in the rooms.
        by_low, by_high, by_along, by_own: zeros in the shape of the inputs.
    """
    for n in range(len(low)):
        for beside in range(3):
            for table in range(len(tables)):
                for option in range(own.shape[1]):
                    car, slope = front_car[n, table, beside, option], by_front[n, table, beside, option]
                    if car == NOBODY or slope == 0:
                        continue
                    leader = max(low[n, car, 2], 0.0)
                    _, in_own, in_leader = used(tables[table], side, own[n, option], leader, level[n, car])
                    by_low[n, car, 0] += slope
                    if low[n, car, 2] >= 0:
                        by_low[n, car, 2] += slope * (rules.period - in_leader)
                    elif rules.meeting[table] > 0:
                        by_low[n, car, 2] += slope * rules.meeting[table]
                    by_along[n] -= slope * rules.period
                    by_own[n, option] -= slope * in_own
            for option in range(own.shape[1]):
                car, slope = rear_car[n, beside, option], by_rear[n, beside, option]
                if car != NOBODY and slope != 0:
                    by_high[n, car, 0] -= slope
                    closing = high[n, car, 2] - own[n, rules.steady]
                    change = slope * _lost(closing, slowing[n, option], rules)[1]
                    by_high[n, car, 2] -= change
                    by_own[n, rules.steady] += change


@entry_point
def speeds(
    low: Floats, high: Floats, present: Flags, lane: Floats, rules: Rules, top: float, fastest: Floats, car_of: Numbers
) -> None:
    """The speed that the cars ahead allow for on each of the lanes `SIDES`: theirs, and the free room over the horizon.

    Args:
        low, high, present, lane, rules: as in `rooms`.
        top: the highest speed in m/s.
        fastest, car_of: the speed [N, S], filled, and the car that limits it or `NOBODY`.
    """
    for n in range(len(low)):
        fastest[n], car_of[n] = top, NOBODY
        for car in range(low.shape[1]):
            if not present[n, car] or not low[n, car, 0] + high[n, car, 0] > 0:
                continue
            left, right = _spread(low[n, car], high[n, car])
            free = max(_middle(low[n, car, 0], high[n, car, 0]) - ROOM, 0.0)
            allowed = _middle(low[n, car, 2], high[n, car, 2]) + free / HORIZON_S
            for place in range(len(SIDES)):
                middle = lane[n] + SIDES[place] * rules.lane_width
                if _overlap(left, right, middle, rules.width) and allowed < fastest[n, place]:
                    fastest[n, place], car_of[n, place] = allowed, car


@entry_point
def speeds_backward(
    low: Floats, high: Floats, car_of: Numbers, by_fastest: Floats, by_low: Floats, by_high: Floats
) -> None:
    """The gradients in the bounds, added to `by_low` and `by_high`, which are zeros; the others as in `speeds`."""
    for n in range(len(low)):
        for place in range(len(SIDES)):
            car, slope = car_of[n, place], by_fastest[n, place]
            if car == NOBODY or slope == 0:
                continue
            _to_bounds(low[n, car], high[n, car], 2, slope, by_low[n, car], by_high[n, car])
            if _middle(low[n, car, 0], high[n, car, 0]) >= ROOM:
                _to_bounds(low[n, car], high[n, car], 0, slope / HORIZON_S, by_low[n, car], by_high[n, car])


@inner
def _to_bounds(low: Floats, high: Floats, f: int, slope: float, by_low: Floats, by_high: Floats) -> None:
    """The gradient of `_middle` in the bounds of a feature."""
    finite = int(np.isfinite(low[f])) + int(np.isfinite(high[f]))
    if np.isfinite(low[f]):
        by_low[f] += slope / finite
    if np.isfinite(high[f]):
        by_high[f] += slope / finite
