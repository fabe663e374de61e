"""The filter of discrete actions over a batch: what it passes on and the mask, with the gradient in what was shown.

The same as `policy.corrected` and the mask of `shield` in torch, to the last bit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavbench.compiled import entry_point, inner
from cavbench.driving.intervals.judge_kernels import (
    ONE,
    TWO,
    ZERO,
    Facts,
    Kept,
    around,
    around_backward,
    judged,
    normalised,
)
from cavbench.driving.intervals.kernels import Flags, Floats, Rules
from cavbench.driving.intervals.motion_kernels import SPEED, Y, clamped


@inner
def _allowed(x: Floats, changeable: Flags, band: np.float32, hard: Floats) -> None:
    """The mask of a point; fills `hard` [5]."""
    needless = x[0] >= band
    for option in range(3):
        hard[option] = ONE if x[option] >= ZERO and not (option > 0 and needless) else ZERO
    for place in range(2):
        hard[3 + place] = ONE if x[3 + place] >= ZERO and changeable[place] else ZERO
    if hard[0] + hard[1] + hard[2] + hard[3] + hard[4] == ZERO:
        most = 2 if x[2] >= x[1] and x[2] >= x[0] else 1 if x[1] >= x[0] else 0
        hard[most] = ONE


@entry_point
def weigh(
    shown: Floats,
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
    band: np.float32,
) -> tuple[Floats, Floats, Floats, Flags, Kept]:
    """What the filter passes on, the margins, the mask, and whether any action is safe.

    Args:
        shown: observations [N, V, F].
        present, predicted, turned, low, high, tables, side, asked, rules, of: as in `judge_kernels.around`.
        band: margin of FASTER from which on slower actions are masked.

    Returns:
        The observation with the reckoned ego [N, V, F]; the margins of FASTER, IDLE, SLOWER, LANE_LEFT and LANE_RIGHT [N, 5];
        1 for those that are allowed, else 0 [N, 5]; whether any is safe [N]; and what `weigh_backward` needs.
    """
    count = len(shown)
    seen, x, hard = shown.copy(), np.empty((count, 5), np.float32), np.empty((count, 5), np.float32)
    safe, changeable, ahead = np.empty(count, np.bool_), np.empty(2, np.bool_), np.empty(3, np.float32)
    kept = around(present, predicted, turned, low, high, tables, side, asked, rules, of)
    for n in range(count):
        now = kept.ego[n]
        seen[n, 0, 2] = clamped(normalised(now[Y], 1, of), -ONE, ONE)
        seen[n, 0, 3] = clamped(normalised(kept.along[n], 2, of), -ONE, ONE)
        seen[n, 0, 4] = clamped(normalised(now[SPEED] * kept.turned[n, 1], 3, of), -ONE, ONE)
        safe[n] = judged(now, kept.front[n], kept.rear[n], kept.right[n], of, ahead, x[n], changeable)
        _allowed(x[n], changeable, band, hard[n])
    return seen, x, hard, safe, kept


@entry_point
def weigh_backward(
    by_seen: Floats, by_x: Floats, tables: Floats, side: int, rules: Rules, of: Facts, kept: Kept
) -> tuple[Floats, Floats, Floats]:
    """The gradients in the shown observations and the bounds of their boxes, from those in what is passed on and the margins.

    Args:
        by_seen, by_x: the gradients [N, V, F] and [N, 5].
        tables, side, rules, of, kept: as in `weigh`.
    """
    count, cars = len(by_seen), by_seen.shape[1] - 1
    by_shown, by_motion = by_seen.copy(), np.zeros((count, 3), np.float32)
    for n in range(count):
        now = kept.ego[n]
        if abs(normalised(now[Y], 1, of)) <= ONE:
            by_motion[n, 0] = by_seen[n, 0, 2] * TWO / of.span[1]
        if abs(normalised(now[SPEED] * kept.turned[n, 0], 2, of)) <= ONE:
            by_motion[n, 1] = by_seen[n, 0, 3] * TWO / of.span[2]
        if abs(normalised(now[SPEED] * kept.turned[n, 1], 3, of)) <= ONE:
            by_motion[n, 2] = by_seen[n, 0, 4] * TWO / of.span[3]
        by_shown[n, 0, 2:] = ZERO
    by_low, by_high = np.zeros((count, cars + 1, 4), np.float32), np.zeros((count, cars + 1, 4), np.float32)
    by_lower, by_upper = np.zeros((count, cars, 4), np.float32), np.zeros((count, cars, 4), np.float32)
    given = tables, side, rules, of, kept
    around_backward(by_x, by_motion, by_lower, by_upper, *given, by_low, by_high)
    return by_shown, by_low, by_high


@entry_point
def masked(values: Floats, hard: Floats, soft: Floats, order: NDArray[np.int64], out: Floats, spread: Floats) -> None:
    """The scores of the filter: those of the masked actions are below the others.

    Args:
        values: the scores of the policy behind it, [N, A].
        hard, soft: the mask in the order of `weigh`, and its soft form, [N, 5].
        order: the place there of each action of the world, [A].
        out, spread: the scores [N, A], and by how much a masked one is lower, [N]; filled.
    """
    for n in range(len(values)):
        least, most = values[n, 0], values[n, 0]
        for action in range(1, values.shape[1]):
            value = values[n, action]
            least = value if value < least or value != value else least
            most = value if value > most or value != value else most
        spread[n] = (most - least) + ONE
        for action in range(values.shape[1]):
            one = order[action]
            allowed = (hard[n, one] + soft[n, one]) - soft[n, one]
            out[n, action] = values[n, action] - spread[n] * (ONE - allowed)


@entry_point
def masked_backward(
    by_out: Floats, soft: Floats, spread: Floats, order: NDArray[np.int64], softness: np.float32, by_x: Floats
) -> None:
    """The gradient in the margins [N, 5], filled, from that in the scores [N, A]; the others as in `masked`.

    That of a soft threshold, `softness` metres wide, stands for that of the mask (straight-through).
    """
    by_x[:] = ZERO
    for n in range(len(by_out)):
        for action in range(by_out.shape[1]):
            one = order[action]
            by_x[n, one] += by_out[n, action] * spread[n] * soft[n, one] * (ONE - soft[n, one]) / softness
