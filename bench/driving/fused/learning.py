"""Compiled training of small networks: the gradient in the weights, Adam's step, and the errors of Q-learning.

The gradient is summed over the points in their order, so a training depends on its seed only.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavbench.compiled import entry_point, rounded_once
from cavbench.driving.fused.kernels import (
    GRAIN,
    LANES,
    SCALED,
    Floats,
    Form,
    Sizes,
    activate_backward,
    add,
    answer_backward,
    fill,
    read,
)


@rounded_once
def _turned(x: Floats, rows: int, count: int, y: Floats) -> None:
    """y [count, rows] = x [rows, count] transposed."""
    for k in range(rows):
        for n in range(count):
            y[n, k] = x[k, n]


@rounded_once
def _summed(by_y: Floats, outputs: int, count: int, by_bias: Floats) -> None:
    """by_bias [outputs] += the sums of by_y [outputs, count]."""
    for j in range(outputs):
        total = np.float32(0)
        for n in range(count):
            total += by_y[j, n]
        by_bias[j] += total


@rounded_once
def _encoder(
    points: Floats,
    start: int,
    count: int,
    weights: Floats,
    form: Form,
    lanes: int,
    best: Floats,
    chosen: Floats,
    by_layer: Floats,
    work: Floats,
    turned: Floats,
    by_weights: Floats,
    by_turned: Floats,
) -> None:
    """Adds the gradient of a block in the weights of the encoder.

    Args:
        by_layer: the gradient in the encoder's output [features - 1 + pooled, lanes].
        work: room for `2 * features + 4 * width + pooled` rows.
        turned: room for `LANES` points of `width` values.
        by_weights: the gradient; that of the pairs and of all biases is added.
        by_turned: the gradient in the weights of the cars [features, width] and then of the ego [features - 1, width]: a vector
            of the processor holds many of the `width`, but would hold few of the `features`.
    """
    size, width, pooled = form.features, form.width, form.pooled
    ego = width * size + width
    pair, at = ego + width * (size - 1), 0
    x, at = work[at : at + size], at + size
    shown, at = work[at : at + size - 1], at + size
    own, at = work[at : at + width], at + width
    hidden, at = work[at : at + width], at + width
    by_hidden, at = work[at : at + width], at + width
    by_own, at = work[at : at + width], at + width
    by_response = work[at : at + pooled]
    by_pair = by_weights[pair : pair + pooled * width].reshape((pooled, width))
    by_pair_bias = by_weights[pair + pooled * width : pair + pooled * (width + 1)]
    read(points, start, count, 1, lanes, shown)
    fill(own, weights, width * size, lanes)
    add(shown, weights, ego, size - 1, 1, size - 1, width, own, lanes)
    by_own[:] = 0
    for row in range(1, form.rows):
        read(points, start, count, row * size, lanes, x)
        number, asked = np.float32(row), False
        for p in range(pooled):
            for n in range(lanes):
                slope = by_layer[size - 1 + p, n] * x[0, n]
                slope = slope if (chosen[p, n] == number) & (best[p, n] > 0) else np.float32(0)
                asked |= slope != 0
                by_response[p, n] = slope
        if not asked:
            continue
        for j in range(width):
            for n in range(lanes):
                hidden[j, n], by_hidden[j, n] = own[j, n], np.float32(0)
        add(x, weights, 0, size, 1, size, width, hidden, lanes)
        add(by_response, weights, pair, 1, width, pooled, width, by_hidden, lanes)
        for j in range(width):
            for n in range(lanes):
                before, slope = hidden[j, n], by_hidden[j, n]
                hidden[j, n] = before if before > 0 else np.float32(0)
                slope = slope if before > 0 else np.float32(0)
                by_hidden[j, n] = slope
                by_own[j, n] += slope
        _turned(hidden, width, count, turned)
        add(turned, by_response.reshape(-1), 0, LANES, 1, count, pooled, by_pair, width)
        _summed(by_response, pooled, count, by_pair_bias)
        _turned(by_hidden, width, count, turned)
        add(turned, x.reshape(-1), 0, LANES, 1, count, size, by_turned[:size], width)
    _summed(by_own, width, count, by_weights[width * size : width * (size + 1)])
    _turned(by_own, width, count, turned)
    add(turned, shown.reshape(-1), 0, LANES, 1, count, size - 1, by_turned[size:], width)


@entry_point
def gradient(
    points: Floats,
    weights: Floats,
    form: Form,
    widths: Sizes,
    kinds: Sizes,
    kept: Floats,
    best: Floats,
    chosen: Floats,
    by_out: Floats,
    by_weights: Floats,
) -> None:
    """The gradient in the weights, from that in the answers; of cars with the same response the first one gets it.

    Args:
        points, weights, form, widths, kinds, kept, best, chosen: as in `kernels.forward`, with as many blocks as the points need.
        by_out: the gradient in the answers [N, A].
        by_weights: the gradient in the weights, filled; that in the factors of a `SCALED` network is 0.
    """
    by_weights[:] = 0
    most, total, size, width = max(widths.max(), form.width), len(weights), form.features, form.width
    if form.last == SCALED:
        total -= widths[-1]
    one, two = np.empty((most, LANES), np.float32), np.empty((most, LANES), np.float32)
    turned = np.empty((LANES, most), np.float32)
    work = np.empty((2 * size + 4 * width + form.pooled, LANES), np.float32)
    by_turned = np.zeros((2 * size, max(1, width)), np.float32)
    for block in range((len(points) + LANES - 1) // LANES):
        start = block * LANES
        count = min(LANES, len(points) - start)
        lanes, layers = (count + GRAIN - 1) // GRAIN * GRAIN, kept[block]
        answer_backward(by_out, weights, total, form.last, start, count, lanes, one[: widths[-1]])
        at, row = total, len(layers) - widths[-1]
        for number in range(len(kinds) - 1, -1, -1):
            inputs, outputs = widths[number], widths[number + 1]
            at -= outputs * (inputs + 1)
            activate_backward(layers[row : row + outputs], kinds[number], lanes, one)
            row -= inputs
            end = at + outputs * inputs
            _turned(layers[row : row + inputs], inputs, count, turned)
            by_layer = by_weights[at:end].reshape((outputs, inputs))
            add(turned, one.reshape(-1), 0, LANES, 1, count, outputs, by_layer, inputs)
            _summed(one, outputs, count, by_weights[end : end + outputs])
            if number > 0 or width:
                two[:inputs] = 0
                add(one[:outputs], weights, at, 1, inputs, outputs, inputs, two[:inputs], lanes)
                one, two = two, one
        if width:
            _encoder(
                points,
                start,
                count,
                weights,
                form,
                lanes,
                best[block],
                chosen[block],
                one,
                work,
                turned,
                by_weights,
                by_turned,
            )
    ego = width * (size + 1)
    for j in range(width):
        for k in range(size):
            by_weights[j * size + k] = by_turned[k, j]
        for k in range(size - 1):
            by_weights[ego + j * (size - 1) + k] = by_turned[size + k, j]


@entry_point
def adam(
    weights: Floats,
    by_weights: Floats,
    first: Floats,
    second: Floats,
    number: int,
    rate: float,
    eps: float,
    longest: float,
    average: Floats,
    tau: float,
) -> None:
    """A step of Adam (Kingma and Ba 2015, torch's defaults) in place, and the weights' running average after it.

    Args:
        weights, by_weights: the weights and their gradient.
        first, second: Adam's moments.
        number: of this step, from 1.
        rate, eps: learning rate, and what is added to the root of the second moment.
        longest: a longer gradient is shortened to this.
        average: moves by `tau` of the way to the new weights; empty for none.
    """
    norm = 0.0
    for value in by_weights:
        norm += np.float64(value) * np.float64(value)
    shorter = np.float32(min(1.0, longest / (np.sqrt(norm) + 1e-6)))
    slow, fast = np.float32(1 - 0.9), np.float32(1 - 0.999)
    kept = np.float32(0.999)
    stride = np.float32(rate / (1 - 0.9**number))
    root, little, share = np.float32(np.sqrt(1 - 0.999**number)), np.float32(eps), np.float32(tau)
    for k in range(len(weights)):
        slope = by_weights[k] * shorter
        first[k] += slow * (slope - first[k])
        second[k] = kept * second[k] + fast * slope * slope
        weights[k] -= stride * first[k] / (np.sqrt(second[k]) / root + little)
    for k in range(len(average)):
        average[k] += share * (weights[k] - average[k])


@entry_point
def errors(
    values: Floats,
    after: Floats,
    targets: Floats,
    action: NDArray[np.int64],
    reward: Floats,
    discount: Floats,
    gap: float,
    allowed: NDArray[np.bool_],
    allowed_after: NDArray[np.bool_],
    by_values: Floats,
) -> None:
    """The gradient of the mean smooth L1 loss of double Q-learning in Q(s, .) (van Hasselt et al. 2016).

    Args:
        values, after: Q(s, .) and Q(s', .) of the network in training [N, A].
        targets: Q(s', .) of the target network [N, A].
        action: the actions taken [N].
        reward: the n-step returns [N].
        discount: of the values at s', 0 where the episode ended in a failure [N].
        gap: share of max Q(s, .) - Q(s, a) that is subtracted from the reward (Bellemare et al. 2016).
        allowed, allowed_after: the actions that a defence leaves at s and s' [N, A].
        by_values: [N, A], filled.
    """
    count, actions = values.shape
    each = np.float32(1) / np.float32(count)
    for n in range(count):
        most, best = np.float32(-np.inf), 0
        highest = np.float32(-np.inf)
        for a in range(actions):
            by_values[n, a] = np.float32(0)
            if allowed[n, a] and values[n, a] > highest:
                highest = values[n, a]
            if allowed_after[n, a] and after[n, a] > most:
                most, best = after[n, a], a
        taken = values[n, action[n]]
        earned = reward[n] - np.float32(gap) * (highest - taken) if gap > 0 else reward[n]
        error = taken - (earned + discount[n] * targets[n, best])
        by_values[n, action[n]] = min(max(error, np.float32(-1)), np.float32(1)) * each
