"""Points of a belief over a batch, their least values, and the gradients of both: compiled loops.

The same as `cavbench.defenses.driving.pessimist_q.Believing.weighed` in torch, to the last bit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cavbench.compiled import entry_point, inner
from cavbench.driving.intervals.kernels import Flags, Floats
from cavbench.driving.intervals.motion_kernels import SPEED, Car, Y, clamped, corrected

ZERO, ONE, TWO = (np.float32(value) for value in (0, 1, 2))


class Scale(NamedTuple):
    """The least value of x, y, vx and vy on the scale of observations, and its range, float32 [4]."""

    low: Floats
    span: Floats


@inner
def _normalised(value: np.float32, f: int, of: Scale) -> np.float32:
    return (value - of.low[f]) / of.span[f] * TWO - ONE


@inner
def _side(point: int, row: int, f: int, ahead: bool, signs: Floats) -> np.float32:
    """The side of the box of a feature that a point is on, -1 to 1: 0 for the middle."""
    if point > 2:
        return signs[point - 3, row, f]
    if point == 0 or f % 2 == 1:
        return ZERO
    return ONE if ahead == (point == 2) else -ONE


@entry_point
def believe(
    shown: Floats,
    present: Flags,
    predicted: Floats,
    turned: Floats,
    low: Floats,
    high: Floats,
    signs: Floats,
    car: Car,
    of: Scale,
    points: Floats,
    motion: Floats,
    slopes: Floats,
) -> None:
    """The points of the belief; fills `points`, `motion` and `slopes`.

    Args:
        shown, present: observations [N, V, F], and the rows that are cars [N, V].
        predicted: the reckoned egos, states [N, 7].
        turned: cosine and sine of their headings, [N, 2]; changed where a heading is.
        low, high: the boxes, [N, V, 4].
        signs: random corners, [K, V, 4].
        car: the kinematics.
        of: the scale.
        points: [N, 3 + K, V, F] the middle, the corner where every car is nearer and closing faster, the opposite one, and the
            random corners; each with the reckoned ego.
        motion: the ego's y, vx and vy on the scale of observations, not clipped, [N, 3].
        slopes: of its y in the bounds of the measured one, and of its speed, [N, 4].
    """
    now, own = np.empty(6, np.float32), np.empty(3, np.float32)
    for n in range(len(shown)):
        corrected(predicted[n], low[n, 0], high[n, 0], car, now, turned[n], slopes[n])
        motion[n, 0] = _normalised(now[Y], 1, of)
        motion[n, 1] = _normalised(now[SPEED] * turned[n, 0], 2, of)
        motion[n, 2] = _normalised(now[SPEED] * turned[n, 1], 3, of)
        for f in range(3):
            own[f] = clamped(motion[n, f], -ONE, ONE)
        for row in range(shown.shape[1]):
            ahead = low[n, row, 0] + high[n, row, 0] >= ZERO
            for point in range(points.shape[1]):
                points[n, point, row, 0] = shown[n, row, 0]
            for f in range(4):
                if row == 0 and f > 0:
                    for point in range(points.shape[1]):
                        points[n, point, row, f + 1] = own[f - 1]
                elif not present[n, row]:
                    for point in range(points.shape[1]):
                        points[n, point, row, f + 1] = shown[n, row, f + 1]
                else:
                    least = clamped(_normalised(low[n, row, f], f, of), -ONE, ONE)
                    most = clamped(_normalised(high[n, row, f], f, of), -ONE, ONE)
                    middle, half = (least + most) / TWO, (most - least) / TWO
                    for point in range(points.shape[1]):
                        points[n, point, row, f + 1] = middle + _side(point, row, f, ahead, signs) * half


@entry_point
def believe_backward(
    by_points: Floats,
    present: Flags,
    turned: Floats,
    low: Floats,
    high: Floats,
    signs: Floats,
    of: Scale,
    motion: Floats,
    slopes: Floats,
    by_shown: Floats,
    by_low: Floats,
    by_high: Floats,
) -> None:
    """The gradients in the observations [N, V, F] and the bounds of their boxes [N, V, 4], which are zeros and are filled.

    Args:
        by_points: the gradient in the points, [N, 3 + K, V, F].
        present, turned, low, high, signs, of, motion, slopes: as `believe` took and left them.
    """
    for n in range(len(by_shown)):
        by_y, by_speed = ZERO, ZERO
        inside = abs(motion[n, 0]) <= ONE, abs(motion[n, 1]) <= ONE, abs(motion[n, 2]) <= ONE
        for point in range(by_points.shape[1]):
            if inside[0]:
                by_y += by_points[n, point, 0, 2] / of.span[1] * TWO
            along = by_points[n, point, 0, 3] / of.span[2] * TWO if inside[1] else ZERO
            across = by_points[n, point, 0, 4] / of.span[3] * TWO if inside[2] else ZERO
            by_speed += along * turned[n, 0] + across * turned[n, 1]
        for row in range(by_shown.shape[1]):
            ahead = low[n, row, 0] + high[n, row, 0] >= ZERO
            for point in range(by_points.shape[1]):
                by_shown[n, row, 0] += by_points[n, point, row, 0]
            for f in range(4 if row else 1):
                by_middle, by_half = ZERO, ZERO
                for point in range(by_points.shape[1]):
                    slope = by_points[n, point, row, f + 1]
                    by_middle += slope
                    by_half += slope * _side(point, row, f, ahead, signs)
                if not present[n, row]:
                    by_shown[n, row, f + 1] = by_middle
                    continue
                # The gradient of a bound outside of the sensor's range is 0.
                if abs(_normalised(low[n, row, f], f, of)) <= ONE:
                    by_low[n, row, f] = (by_middle - by_half) / TWO / of.span[f] * TWO
                if abs(_normalised(high[n, row, f], f, of)) <= ONE:
                    by_high[n, row, f] = (by_middle + by_half) / TWO / of.span[f] * TWO
        by_low[n, 0, 1], by_high[n, 0, 1] = by_y * slopes[n, 0], by_y * slopes[n, 1]
        by_low[n, 0, 2], by_high[n, 0, 2] = by_speed * slopes[n, 2], by_speed * slopes[n, 3]


@entry_point
def least(values: Floats, pessimism: np.float32, scores: Floats) -> None:
    """The values of actions at the middle of a belief, moved towards their least ones; fills `scores` [N, A].

    Args:
        values: those at each point, the middle first, [N, P, A]. Of those with a NaN the least is NaN.
        pessimism: the share of the way that they are moved.
    """
    for n in range(len(values)):
        for a in range(values.shape[2]):
            middle = lowest = values[n, 0, a]
            for point in range(1, values.shape[1]):
                value = values[n, point, a]
                if value < lowest or value != value:
                    lowest = value
            scores[n, a] = middle + pessimism * (lowest - middle)


@entry_point
def least_backward(by_scores: Floats, values: Floats, pessimism: np.float32, by_values: Floats) -> None:
    """The gradient in the values at each point, [N, P, A], filled; points that share the least value share its gradient.

    Args:
        by_scores: the gradient in the scores, [N, A].
        values, pessimism: as `least` took them.
    """
    for n in range(len(values)):
        for a in range(values.shape[2]):
            lowest, count = values[n, 0, a], 0
            for point in range(values.shape[1]):
                value = values[n, point, a]
                if value < lowest or value != value:
                    lowest, count = value, 0
                if value == lowest:
                    count += 1
            slope = by_scores[n, a]
            by_least = slope * pessimism
            share = by_least / np.float32(count) if count else np.float32(np.nan)
            for point in range(values.shape[1]):
                by_values[n, point, a] = share if values[n, point, a] == lowest or not count else ZERO
            by_values[n, 0, a] += slope - by_least
