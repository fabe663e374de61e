"""What each action is worth to a driver by rules, over a batch, with the gradient in the boxes: compiled loops.

The same as `cavbench.driving.victims.planner.IntervalPlanner` in torch, to the last bit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavbench.compiled import entry_point, inner
from cavbench.driving.intervals import kernels
from cavbench.driving.intervals.judge_kernels import ONE, ZERO, Facts, Kept, around, around_backward, judged
from cavbench.driving.intervals.kernels import Flags, Floats, Numbers, Rules
from cavbench.driving.intervals.motion_kernels import EDGE, LANE, UNKNOWN_EDGE

OWN = len(kernels.SIDES) // 2
"""The place of the own lane among the lanes `SIDES`."""


class Worths(NamedTuple):
    """The constants of `cavbench.driving.victims.planner` and the rules of the driver, float32.

    Args:
        forbidden, unsafe: values of what is never done, and of what is done only if nothing is safe.
        lane, speed, slowest, span: shares of the lane and the speed, the speed where progress begins, and from there to the top.
        per_metre, tie_break: value of a metre of margin where nothing is safe, and elsewhere.
        order: differences between FASTER, IDLE and SLOWER, [3].
        right, gain, detour: of the rules.
    """

    forbidden: np.float32
    unsafe: np.float32
    lane: np.float32
    speed: np.float32
    slowest: np.float32
    span: np.float32
    per_metre: np.float32
    tie_break: np.float32
    order: Floats
    right: np.float32
    gain: np.float32
    detour: np.float32


@inner
def _lanes(now: Floats, fastest: Floats, of: Worths, worth: Floats) -> None:
    """The progress on each of the lanes `SIDES`, less the detours to it; fills `worth` [9]."""
    edge = now[EDGE]
    per_lane = ONE / (edge if edge > ONE else ONE) * of.lane if edge < np.float32(UNKNOWN_EDGE) else of.right
    for place in range(len(kernels.SIDES)):
        side = np.float32(kernels.SIDES[place])
        lane, beyond = now[LANE] + side, max(abs(kernels.SIDES[place]) - 1, 0)
        worth[place] = of.speed * (fastest[place] - of.slowest) / of.span + per_lane * side
        if not (lane >= ZERO and lane <= edge):
            worth[place] = of.forbidden
        if place != OWN:
            worth[place] -= of.detour * np.float32(beyond)


@entry_point
def worth(
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
    top: float,
    values: Worths,
    order: NDArray[np.int64],
) -> tuple[Floats, Flags, Floats, Flags, Floats, Numbers, Kept]:
    """The scores of the driver, and whether any action is safe.

    Args:
        present, predicted, turned, low, high, tables, side, asked, rules, of: as in `judge_kernels.around`.
        top: the highest speed in m/s.
        values: see `Worths`.
        order: the place of each action of the world among FASTER, IDLE, SLOWER, LANE_LEFT and LANE_RIGHT, [A].

    Returns:
        The scores [N, A]; whether any action is safe [N]; and what `worth_backward` needs: the margins [N, 5], whether the ego
        may change lanes [N, 2], the worth of the lanes `SIDES` [N, S], the cars that limit it [N, S], and what `around` keeps.
    """
    count, sides = len(low), len(kernels.SIDES)
    scores, safe = np.empty((count, len(order)), np.float32), np.empty(count, np.bool_)
    x, changeable = np.empty((count, 5), np.float32), np.empty((count, 2), np.bool_)
    lanes, fastest, limits = (
        np.empty((count, sides), np.float32),
        np.empty((count, sides), np.float32),
        np.empty((count, sides), np.int8),
    )
    kept = around(present, predicted, turned, low, high, tables, side, asked, rules, of)
    kernels.speeds(kept.low, kept.high, kept.others, kept.lane, rules, top, fastest, limits)
    ahead, ordered = np.empty(3, np.float32), np.empty(5, np.float32)
    for n in range(count):
        safe[n] = judged(kept.ego[n], kept.front[n], kept.rear[n], kept.right[n], of, ahead, x[n], changeable[n])
        _lanes(kept.ego[n], fastest[n], values, lanes[n])
        for option in range(3):
            if x[n, option] < ZERO:
                ordered[option] = values.unsafe + values.per_metre * (x[n, option] - values.order[option])
            else:
                ordered[option] = lanes[n, OWN] + values.order[option] + values.tie_break * x[n, option]
        for place in range(2):
            margin = x[n, 3 + place]
            best = np.max(lanes[n, :OWN]) if place == 0 else np.max(lanes[n, OWN + 1 :])
            if not changeable[n, place]:
                ordered[3 + place] = values.forbidden
            elif margin < ZERO:
                ordered[3 + place] = values.forbidden + values.per_metre * margin
            else:
                ordered[3 + place] = best - values.gain + values.tie_break * margin
        for action in range(len(order)):
            scores[n, action] = ordered[order[action]]
    return scores, safe, x, changeable, lanes, limits, kept


@entry_point
def worth_backward(
    by_scores: Floats,
    x: Floats,
    changeable: Flags,
    lanes: Floats,
    limits: Numbers,
    kept: Kept,
    tables: Floats,
    side: int,
    rules: Rules,
    of: Facts,
    values: Worths,
    order: NDArray[np.int64],
) -> tuple[Floats, Floats]:
    """The gradients in the bounds of the boxes [N, V, 4], from those in the scores [N, A]; the others as in `worth`."""
    count, cars = len(by_scores), kept.low.shape[1]
    by_x, by_fastest = np.zeros((count, 5), np.float32), np.zeros(lanes.shape, np.float32)
    for n in range(count):
        for action in range(len(order)):
            one = order[action]
            slope = by_scores[n, action]
            if one >= 3 and not changeable[n, one - 3]:
                continue
            by_x[n, one] += slope * (values.per_metre if x[n, one] < ZERO else values.tie_break)
            if x[n, one] < ZERO:
                continue
            first, last = (OWN, OWN + 1) if one < 3 else (0, OWN) if one == 3 else (OWN + 1, lanes.shape[1])
            best, ties = np.max(lanes[n, first:last]), ZERO
            for place in range(first, last):
                ties += ONE if lanes[n, place] == best else ZERO
            for place in range(first, last):
                lane = kept.ego[n, LANE] + np.float32(kernels.SIDES[place])
                if lanes[n, place] == best and lane >= ZERO and lane <= kept.ego[n, EDGE]:
                    by_fastest[n, place] += slope / ties / values.span * values.speed
    by_low, by_high = np.zeros((count, cars + 1, 4), np.float32), np.zeros((count, cars + 1, 4), np.float32)
    by_lower, by_upper = np.zeros((count, cars, 4), np.float32), np.zeros((count, cars, 4), np.float32)
    kernels.speeds_backward(kept.low, kept.high, limits, by_fastest, by_lower, by_upper)
    motion, given = np.zeros((count, 3), np.float32), (tables, side, rules, of, kept)
    around_backward(by_x, motion, by_lower, by_upper, *given, by_low, by_high)
    return by_low, by_high
