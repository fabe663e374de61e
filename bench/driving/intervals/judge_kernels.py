"""Margins of actions over a batch: the reckoned ego, the cars around it and their rooms, with the gradient in the boxes.

The same as `ego.DeadReckoning.now` and `margins.Judge` in torch, to the last bit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cavbench.compiled import inner
from cavbench.driving.intervals import kernels
from cavbench.driving.intervals.kernels import Flags, Floats, Numbers, Rules
from cavbench.driving.intervals.motion_kernels import (
    EDGE,
    HEADING,
    LANE,
    SPEED,
    TARGET,
    UNKNOWN_EDGE,
    Car,
    Y,
    clamped,
    corrected,
)

ZERO, HALF, ONE, TWO = (np.float32(value) for value in (0, 0.5, 1, 2))
FREE = np.float32(kernels.FREE)


class Facts(NamedTuple):
    """What the loops below need of the world and of the constants of `margins`; float32 but for the counts.

    Args:
        car: the kinematics.
        parts: number of the parts of the way out of a lane.
        kept: share of the difference to the target speed that is left after a decision.
        settled_m, settled_rad, clearing_m: of `Judge`.
        low, span: the least value of x, y, vx and vy on the scale of observations, and its range, [4].
    """

    car: Car
    parts: int
    kept: np.float32
    settled_m: np.float32
    settled_rad: np.float32
    clearing_m: np.float32
    low: Floats
    span: Floats


class Kept(NamedTuple):
    """What the gradient needs, for N points with C other cars, T tables and O options; as in `kernels.rooms` from `low` on.

    Args:
        ego: the ego now, [N, 6].
        turned: cosine and sine of its heading, [N, 2].
        slopes: of its y in the bounds of the measured one, and of its speed, [N, 4].
        right: whether it is known that there is a lane on the right, [N].
        others, lane: the other cars that are present [N, C], and the middle of the target lane in m, [N].
        low, high, along, own, slowing, front, front_car, rear, rear_car, level: the rooms, and what they follow from.
    """

    ego: Floats
    turned: Floats
    slopes: Floats
    right: Flags
    others: Flags
    lane: Floats
    low: Floats
    high: Floats
    along: Floats
    own: Floats
    slowing: Floats
    front: Floats
    front_car: Numbers
    rear: Floats
    rear_car: Numbers
    level: Numbers


@inner
def _lesser(a: np.float32, b: np.float32) -> np.float32:
    """The share of the gradient of min(a, b) that goes to a."""
    return ONE if a < b else HALF if a == b else ZERO


@inner
def normalised(value: np.float32, f: int, of: Facts) -> np.float32:
    return (value - of.low[f]) / of.span[f] * TWO - ONE


@inner
def _commanded(speed: np.float32, change: np.float32, of: Facts) -> np.float32:
    """`DeadReckoning.commanded` after FASTER or SLOWER."""
    top = np.float32(of.car.last)
    index = clamped(np.rint((speed - of.car.lowest) / of.car.range * top), ZERO, top) + change
    return of.car.lowest + clamped(index, ZERO, top) * of.car.spacing


@inner
def _options(now: Floats, of: Facts, own: Floats, slowing: Floats) -> None:
    """`Judge._options`."""
    speed, kept = now[SPEED], now[TARGET]
    faster, slower = _commanded(speed, ONE, of), _commanded(speed, -ONE, of)
    own[0] = faster + (speed - faster) * of.kept
    own[1] = kept + (speed - kept) * of.kept
    own[2] = slower + (speed - slower) * of.kept
    aim = faster if kept < speed else kept
    own[3] = aim if speed < aim else speed
    slowing[0], slowing[1], slowing[2], slowing[3] = speed - faster, speed - kept, speed - slower, speed - own[1]
    for option in range(4):
        slowing[option] = ZERO if slowing[option] < ZERO else slowing[option]


@inner
def _place(now: Floats, of: Facts) -> tuple[bool, int, int]:
    """Whether the ego is in its target lane; the side of the lane that it is leaving; which part of the way out counts."""
    off = now[Y] - of.car.lane_width * now[LANE]
    settled = abs(off) < of.settled_m and abs(now[HEADING]) < of.settled_rad
    moved = (of.car.lane_width - abs(off)) / of.clearing_m
    side = 0 if not moved < ONE else 1 if off > ZERO else -1 if off < ZERO else 0
    part = min(max(int(moved * np.float32(of.parts)), 0), of.parts - 1)
    return settled, side, part


@inner
def _staying(front: Floats, rear: Floats, settled: bool, side: int, part: int, ahead: Floats, stay: Floats) -> None:
    """The room ahead of FASTER, IDLE and SLOWER, and their margins; fills `ahead` and `stay` [3]."""
    room = False
    for option in range(3):
        leaving = FREE if side == 0 else front[3 + part, 1 + side, option]
        ahead[option] = leaving if leaving < front[0, 1, option] else front[0, 1, option]
        behind = rear[1, option]
        if settled and not room:
            stay[option] = ahead[option]
        else:
            stay[option] = behind if behind < ahead[option] else ahead[option]
        room |= ahead[option] >= ZERO


@inner
def _beside(front: Floats, rear: Floats, to: int) -> tuple[np.float32, np.float32, np.float32, np.float32, np.float32]:
    """The rooms that a lane change depends on: beside, its least one behind, faster, in the lane that is left, and past it."""
    least = min(rear[to, 0], rear[to, 1], rear[to, 2])
    beside = least if least < front[0, to, 1] else front[0, to, 1]
    faster = rear[to, 3] if rear[to, 3] < front[1, to, 3] else front[1, to, 3]
    return beside, least, faster, front[3, 1, 1], front[2, 1, 1]


@inner
def judged(
    now: Floats, front: Floats, rear: Floats, right: bool, of: Facts, ahead: Floats, x: Floats, changeable: Flags
) -> bool:
    """The margins of a point, and whether any action is safe.

    Args:
        now, front, rear, right, of: of the point.
        ahead: room for what is computed on the way, [3].
        x: the margins of FASTER, IDLE, SLOWER and both lane changes, ways out included, [5]; filled.
        changeable: whether the ego may change lanes to the left and to the right, [2]; filled.
    """
    settled, side, part = _place(now, of)
    _staying(front, rear, settled, side, part, ahead, x)
    best = max(ahead[0], ahead[1], ahead[2])
    unsafe = x[0] < ZERO and x[1] < ZERO and x[2] < ZERO
    found = False
    for place in range(2):
        beside, _, faster, leave, past = _beside(front, rear, 2 * place)
        careful, swift = min(beside, leave), min(faster, past)
        limit = FREE if place == 0 or right else x[1]
        exists = now[LANE] > ZERO if place == 0 else now[LANE] < now[EDGE]
        change = min(max(careful, swift), limit)
        out = min(beside if best < ZERO and best < leave else -FREE, limit)
        if not exists:
            change, out = -FREE, -FREE
        changeable[place] = settled or (unsafe and side == (-1 if place == 0 else 1))
        x[3 + place] = max(change, out)
        found |= change >= ZERO and changeable[place]
    return found or not unsafe


@inner
def judged_backward(
    now: Floats,
    front: Floats,
    rear: Floats,
    right: bool,
    of: Facts,
    by_x: Floats,
    ahead: Floats,
    stay: Floats,
    by_front: Floats,
    by_rear: Floats,
) -> None:
    """The gradients of a point in the rooms, added to `by_front` [T, 3, O] and `by_rear` [3, O]; changes `by_x` [5]."""
    settled, side, part = _place(now, of)
    _staying(front, rear, settled, side, part, ahead, stay)
    best = max(ahead[0], ahead[1], ahead[2])
    for place in range(2):
        slope, to = by_x[3 + place], 2 * place
        exists = now[LANE] > ZERO if place == 0 else now[LANE] < now[EDGE]
        if slope == ZERO or not exists:
            continue
        beside, least, faster, leave, past = _beside(front, rear, to)
        careful, swift = min(beside, leave), min(faster, past)
        limit, by_limit = FREE if place == 0 or right else stay[1], ZERO
        leads = best < ZERO and best < leave
        change, out = min(max(careful, swift), limit), min(beside if leads else -FREE, limit)
        by_change = slope * _lesser(out, change)
        by_out = slope - by_change
        share = _lesser(max(careful, swift), limit)
        by_limit += by_change * (ONE - share)
        by_careful = by_change * share * _lesser(swift, careful)
        by_swift = by_change * share - by_careful
        share = _lesser(beside if leads else -FREE, limit)
        by_limit += by_out * (ONE - share)
        by_beside = by_careful * _lesser(beside, leave) + (by_out * share if leads else ZERO)
        by_front[3, 1, 1] += by_careful * (ONE - _lesser(beside, leave))
        share = _lesser(faster, past)
        by_front[2, 1, 1] += by_swift * (ONE - share)
        by_faster = by_swift * share
        share = _lesser(front[1, to, 3], rear[to, 3])
        by_front[1, to, 3] += by_faster * share
        by_rear[to, 3] += by_faster * (ONE - share)
        share = _lesser(front[0, to, 1], least)
        by_front[0, to, 1] += by_beside * share
        ties = ZERO
        for option in range(3):
            ties += ONE if rear[to, option] == least else ZERO
        for option in range(3):
            if rear[to, option] == least:
                by_rear[to, option] += by_beside * (ONE - share) / ties
        if place == 1 and not right:
            by_x[1] += by_limit
    room = False
    for option in range(3):
        by_ahead = by_x[option]
        if not settled or room:
            share = _lesser(ahead[option], rear[1, option])
            by_rear[1, option] += by_ahead * (ONE - share)
            by_ahead *= share
        room |= ahead[option] >= ZERO
        leaving = FREE if side == 0 else front[3 + part, 1 + side, option]
        share = _lesser(front[0, 1, option], leaving)
        by_front[0, 1, option] += by_ahead * share
        if side != 0:
            by_front[3 + part, 1 + side, option] += by_ahead * (ONE - share)


@inner
def around(
    present: Flags,
    predicted: Floats,
    turned: Floats,
    low: Floats,
    high: Floats,
    tables: Floats,
    side: int,
    asked: Flags,
    rules: Rules,
    of: Facts,
) -> Kept:
    """The ego at N observations, the cars around it, and the rooms.

    Args:
        present: the rows that are cars [N, V].
        predicted: the reckoned egos, states [N, 7].
        turned: cosine and sine of their headings, [N, 2]; changed where a heading is.
        low, high: the boxes, [N, V, F - 1].
        tables, side, asked, rules: as in `kernels.rooms`.
        of: see `Facts`.
    """
    count, cars = len(low), low.shape[1] - 1
    ego, slopes = np.empty((count, 6), np.float32), np.empty((count, 4), np.float32)
    lower, upper = np.empty((count, cars, 4), np.float32), np.empty((count, cars, 4), np.float32)
    others, right = np.empty((count, cars), np.bool_), np.empty(count, np.bool_)
    along, lane = np.empty(count, np.float32), np.empty(count, np.float32)
    wanted = np.empty((count, *asked.shape), np.bool_)
    own, slowing = np.empty((count, 4), np.float32), np.empty((count, 4), np.float32)
    for n in range(count):
        now = ego[n]
        corrected(predicted[n], low[n, 0], high[n, 0], of.car, now, turned[n], slopes[n])
        along[n], lane[n] = now[SPEED] * turned[n, 0], of.car.lane_width * now[LANE]
        across = now[SPEED] * turned[n, 1]
        rightmost = -np.float32(np.inf)
        for car in range(cars):
            lower[n, car, 0], upper[n, car, 0] = low[n, car + 1, 0], high[n, car + 1, 0]
            lower[n, car, 1], upper[n, car, 1] = low[n, car + 1, 1] + now[Y], high[n, car + 1, 1] + now[Y]
            lower[n, car, 2], upper[n, car, 2] = low[n, car + 1, 2] + along[n], high[n, car + 1, 2] + along[n]
            lower[n, car, 3], upper[n, car, 3] = low[n, car + 1, 3] + across, high[n, car + 1, 3] + across
            others[n, car] = present[n, car + 1]
            place = lower[n, car, 1] / of.car.lane_width if others[n, car] else ZERO
            rightmost = place if place > rightmost else rightmost
        right[n] = np.rint(rightmost) > now[LANE] or now[EDGE] < np.float32(UNKNOWN_EDGE)
        _options(now, of, own[n], slowing[n])
        # Of the ways out of a lane only that part counts in which the ego is.
        _, leaves, part = _place(now, of)
        wanted[n] = asked
        for option in range(3):
            for one in range(of.parts):
                wanted[n, 3 + one, option] = (leaves != 0 and one == part) or (one == 0 and option == 1)
    front = np.empty((count, len(tables), 3, 4), np.float32)
    rear, level = np.empty((count, 3, 4), np.float32), np.zeros((count, cars), np.int8)
    front_car, rear_car = np.empty(front.shape, np.int8), np.empty(rear.shape, np.int8)
    given = lower, upper, others, along, lane, own, slowing
    kernels.rooms(*given, tables, side, wanted, rules, front, front_car, rear, rear_car, level)
    kept = ego, turned, slopes, right, others, lane, lower, upper, along, own, slowing
    return Kept(*kept, front, front_car, rear, rear_car, level)


@inner
def around_backward(
    by_x: Floats,
    by_motion: Floats,
    by_lower: Floats,
    by_upper: Floats,
    tables: Floats,
    side: int,
    rules: Rules,
    of: Facts,
    kept: Kept,
    by_low: Floats,
    by_high: Floats,
) -> None:
    """The gradients in the boxes, `by_low` and `by_high` [N, V, 4], zeros that are filled.

    Args:
        by_x: the gradients in the margins, [N, 5].
        by_motion: those in the ego's y, and its speed along and across the road, besides, [N, 3].
        by_lower, by_upper: those in the bounds of the other cars in the road's frame besides, [N, C, 4]; changed.
        tables, side, rules, of, kept: as in `around`.
    """
    count, cars = len(by_x), by_lower.shape[1]
    by_front, by_rear = np.zeros(kept.front.shape, np.float32), np.zeros(kept.rear.shape, np.float32)
    ahead, stay, into = np.empty(3, np.float32), np.empty(3, np.float32), np.empty(5, np.float32)
    for n in range(count):
        into[:] = by_x[n]
        rooms = kept.front[n], kept.rear[n]
        judged_backward(kept.ego[n], *rooms, kept.right[n], of, into, ahead, stay, by_front[n], by_rear[n])
    by_along, by_own = np.zeros(count, np.float32), np.zeros((count, 4), np.float32)
    given = kept.low, kept.high, kept.along, kept.own, kept.slowing, tables, side, rules
    found = kept.front_car, kept.rear_car, kept.level, by_front, by_rear
    kernels.rooms_backward(*given, *found, by_lower, by_upper, by_along, by_own)
    for n in range(count):
        now, cos, sin = kept.ego[n], kept.turned[n, 0], kept.turned[n, 1]
        by_y, by_across = ZERO, ZERO
        for car in range(cars):
            by_low[n, car + 1], by_high[n, car + 1] = by_lower[n, car], by_upper[n, car]
            by_y += by_lower[n, car, 1] + by_upper[n, car, 1]
            by_along[n] += by_lower[n, car, 2] + by_upper[n, car, 2]
            by_across += by_lower[n, car, 3] + by_upper[n, car, 3]
        by_y += by_motion[n, 0]
        by_along[n] += by_motion[n, 1]
        by_across += by_motion[n, 2]
        by_speed = by_along[n] * cos + by_across * sin + of.kept * (by_own[n, 0] + by_own[n, 1] + by_own[n, 2])
        faster = _commanded(now[SPEED], ONE, of) if now[TARGET] < now[SPEED] else now[TARGET]
        by_speed += by_own[n, 3] * _lesser(faster, now[SPEED])
        by_low[n, 0, 1], by_high[n, 0, 1] = by_y * kept.slopes[n, 0], by_y * kept.slopes[n, 1]
        by_low[n, 0, 2], by_high[n, 0, 2] = by_speed * kept.slopes[n, 2], by_speed * kept.slopes[n, 3]
