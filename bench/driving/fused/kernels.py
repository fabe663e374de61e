"""Compiled passes of small networks, forward and backward to the observation, in blocks of `LANES` points.

A value is stored as a row over the points of a block, so the processor computes many points at once and each point is summed
in one fixed order: its answer does not depend on the other points or on its place among them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavbench.compiled import entry_point, rounded_once
from cavbench.driving.fused import tiles

LANES, GRAIN = 64, 16
"""Points in a block, and what the number of points in the last one is rounded up to: the width of the largest registers."""
LINEAR, RELU, TANH = 0, 1, 2
"""Activations after a layer."""
PLAIN, DUELING, SCALED = 0, 1, 2
"""What becomes of the last layer: nothing; a state value and advantages, Wang et al. 2016; each output times a factor."""
NOBODY = -1.0

Floats = NDArray[np.float32]
Sizes = NDArray[np.int64]


class Form(NamedTuple):
    """A network, but for its weights.

    Args:
        rows, features: V and F of an observation; the encoder's input.
        width, pooled: sizes of the encoder's layers; 0 without an encoder, and the layers then read all V * F values.
        last: what becomes of the last layer, for instance `DUELING`.
    """

    rows: int
    features: int
    width: int
    pooled: int
    last: int


@rounded_once
def add(
    x: Floats, weights: Floats, at: int, by_output: int, by_input: int, inputs: int, outputs: int, y: Floats, lanes: int
) -> None:
    """y [outputs, lanes] += w @ x, for x [inputs, lanes] and the weight of (j, k) at `at + j * by_output + k * by_input`.

    The inputs are added one after the other.
    """
    whole, fours = outputs - outputs % 4, inputs - inputs % 4
    for j in range(0, whole, 4):
        one = at + j * by_output
        two, three, four = one + by_output, one + 2 * by_output, one + 3 * by_output
        for k in range(0, fours, 4):
            p, q, r, s = k * by_input, (k + 1) * by_input, (k + 2) * by_input, (k + 3) * by_input
            a0, a1, a2, a3 = weights[one + p], weights[one + q], weights[one + r], weights[one + s]
            b0, b1, b2, b3 = weights[two + p], weights[two + q], weights[two + r], weights[two + s]
            c0, c1, c2, c3 = weights[three + p], weights[three + q], weights[three + r], weights[three + s]
            d0, d1, d2, d3 = weights[four + p], weights[four + q], weights[four + r], weights[four + s]
            for n in range(lanes):
                x0, x1, x2, x3 = x[k, n], x[k + 1, n], x[k + 2, n], x[k + 3, n]
                y[j, n] = (((y[j, n] + a0 * x0) + a1 * x1) + a2 * x2) + a3 * x3
                y[j + 1, n] = (((y[j + 1, n] + b0 * x0) + b1 * x1) + b2 * x2) + b3 * x3
                y[j + 2, n] = (((y[j + 2, n] + c0 * x0) + c1 * x1) + c2 * x2) + c3 * x3
                y[j + 3, n] = (((y[j + 3, n] + d0 * x0) + d1 * x1) + d2 * x2) + d3 * x3
        for k in range(fours, inputs):
            p = k * by_input
            a0, b0, c0, d0 = weights[one + p], weights[two + p], weights[three + p], weights[four + p]
            for n in range(lanes):
                x0 = x[k, n]
                y[j, n] += a0 * x0
                y[j + 1, n] += b0 * x0
                y[j + 2, n] += c0 * x0
                y[j + 3, n] += d0 * x0
    for j in range(whole, outputs):
        for k in range(inputs):
            a0 = weights[at + j * by_output + k * by_input]
            for n in range(lanes):
                y[j, n] += a0 * x[k, n]


@rounded_once
def fill(y: Floats, weights: Floats, at: int, lanes: int) -> None:
    """The biases as the beginning of each sum."""
    for j in range(len(y)):
        for n in range(lanes):
            y[j, n] = weights[at + j]


@rounded_once
def tanh(x: np.float32) -> np.float32:
    """tanh, to about 3e-7: the rational function of Eigen (`ptanh_float`). A call of the library would be one for each number."""
    x = np.float32(-7.90531110763549805) if x < -7.90531110763549805 else x
    x = np.float32(7.90531110763549805) if x > 7.90531110763549805 else x
    s = x * x
    p = s * np.float32(-2.76076847742355e-16) + np.float32(2.00018790482477e-13)
    p = s * p + np.float32(-8.60467152213735e-11)
    p = s * p + np.float32(5.12229709037114e-08)
    p = s * p + np.float32(1.48572235717979e-05)
    p = s * p + np.float32(6.37261928875436e-04)
    p = s * p + np.float32(4.89352455891786e-03)
    q = s * np.float32(1.19825839466702e-06) + np.float32(1.18534705686654e-04)
    q = s * q + np.float32(2.26843463243900e-03)
    q = s * q + np.float32(4.89352518554385e-03)
    return x * p / q


@rounded_once
def _activate(y: Floats, kind: int, lanes: int) -> None:
    """An activation in place. NaN stays NaN."""
    if kind == RELU:
        for j in range(len(y)):
            for n in range(lanes):
                value = y[j, n]
                y[j, n] = np.float32(0) if value < 0 else value
    if kind == TANH:
        for j in range(len(y)):
            for n in range(lanes):
                y[j, n] = tanh(y[j, n])


@rounded_once
def read(points: Floats, start: int, count: int, first: int, lanes: int, x: Floats) -> None:
    """The values from `first` on of the points of a block, a row for each; places without a point are 0."""
    for k in range(len(x)):
        for n in range(count):
            x[k, n] = points[start + n, first + k]
        for n in range(count, lanes):
            x[k, n] = np.float32(0)


@rounded_once
def _encode(
    points: Floats,
    start: int,
    count: int,
    weights: Floats,
    form: Form,
    lanes: int,
    layer: Floats,
    best: Floats,
    chosen: Floats,
    work: Floats,
) -> None:
    """The encoder (`cavbench.driving.victims.networks.Encoder`) of a block.

    Args:
        layer: the ego's features and the largest responses [features - 1 + pooled, lanes], filled.
        best, chosen: each largest response, at least 0, and the row of its car or `NOBODY`, [pooled, lanes], filled.
        work: room for `features + 2 * (width + pooled)` rows.
    """
    size, width, pooled = form.features, form.width, form.pooled
    car, ego = 0, width * size + width
    pair = ego + width * (size - 1)
    x, own, hidden = work[:size], work[size : size + width], work[size + width : size + 2 * width]
    response, bias = work[size + 2 * width : size + 2 * width + pooled], work[size + 2 * width + pooled :]
    used = np.empty(max(size, width) + 1, np.int64)
    read(points, start, count, 1, lanes, layer[: size - 1])
    fill(own, weights, car + width * size, lanes)
    fill(bias, weights, pair + pooled * width, lanes)
    tiles.add(layer[: size - 1], weights, ego, size - 1, 1, size - 1, width, own, lanes)
    for p in range(pooled):
        for n in range(lanes):
            best[p, n], chosen[p, n] = np.float32(0), np.float32(NOBODY)
    for row in range(1, form.rows):
        read(points, start, count, row * size, lanes, x)
        number = np.float32(row)
        for first in range(0, lanes, tiles.WIDTH):
            if tiles.empty(x, first, used):
                # Its responses are 0, and so is the least of the largest.
                continue
            tiles.part(x, weights, car, size, 1, size, width, own, hidden, first, used, True)
            tiles.part(hidden, weights, pair, width, 1, width, pooled, bias, response, first, used, False)
            for p in range(pooled):
                tiles.pool(response, x, first, number, best, chosen, p)
    for p in range(pooled):
        for n in range(lanes):
            layer[size - 1 + p, n] = best[p, n]


@entry_point
def forward(
    points: Floats,
    weights: Floats,
    form: Form,
    widths: Sizes,
    kinds: Sizes,
    out: Floats,
    kept: Floats,
    best: Floats,
    chosen: Floats,
) -> None:
    """The answers of a network; fills `out`, and for `backward` `kept`, `best` and `chosen`.

    Args:
        points: observations [N, V * F].
        weights: all weights in one vector. First the encoder's: of the cars [width, features] and their bias, of the ego [width,
            features - 1], of the pairs [pooled, width] and their bias. Then of each layer [outputs, inputs] and its bias. Last
            the factors, if the last layer is `SCALED`.
        form, widths, kinds: the network; number of inputs of each layer, then of the last one's outputs; activations.
        out: the answers [N, A].
        kept: inputs of the layers and the last one's outputs, one after the other, [blocks, sum of widths, LANES]. With one
            block for several, each is overwritten by the next.
        best, chosen: as of `_encode`, [blocks, pooled, LANES].
    """
    size, keeps = form.features, len(kept) > 1
    work = np.empty((size + 2 * (form.width + form.pooled), LANES), np.float32)
    head = 0
    if form.width:
        head = form.width * 2 * size + form.pooled * (form.width + 1)
    for block in range((len(points) + LANES - 1) // LANES):
        start, place = block * LANES, block if keeps else 0
        count = min(LANES, len(points) - start)
        lanes, layers = (count + GRAIN - 1) // GRAIN * GRAIN, kept[place]
        if form.width:
            _encode(points, start, count, weights, form, lanes, layers[: widths[0]], best[place], chosen[place], work)
        else:
            read(points, start, count, 0, lanes, layers[: widths[0]])
        at, row = head, 0
        for number in range(len(kinds)):
            inputs, outputs = widths[number], widths[number + 1]
            y = layers[row + inputs : row + inputs + outputs]
            fill(y, weights, at + outputs * inputs, lanes)
            tiles.add(layers[row : row + inputs], weights, at, inputs, 1, inputs, outputs, y, lanes)
            _activate(y, kinds[number], lanes)
            at, row = at + outputs * (inputs + 1), row + inputs
        _answer(layers[row : row + widths[-1]], weights, at, form.last, start, count, out)


@rounded_once
def _answer(y: Floats, weights: Floats, at: int, last: int, start: int, count: int, out: Floats) -> None:
    """The answers of a block from the outputs of its last layer."""
    for n in range(count):
        if last == DUELING:
            mean = np.float32(0)
            for j in range(1, len(y)):
                mean += y[j, n]
            mean /= np.float32(len(y) - 1)
            for j in range(1, len(y)):
                out[start + n, j - 1] = (y[0, n] + y[j, n]) - mean
        else:
            for j in range(len(y)):
                out[start + n, j] = y[j, n] * weights[at + j] if last == SCALED else y[j, n]


@entry_point
def backward(
    points: Floats,
    weights: Floats,
    form: Form,
    widths: Sizes,
    kinds: Sizes,
    kept: Floats,
    best: Floats,
    chosen: Floats,
    by_out: Floats,
    by_points: Floats,
) -> None:
    """The gradient in the points, from that in the answers; of cars with the same response the first one gets it.

    Args:
        points, weights, form, widths, kinds, kept, best, chosen: as in `forward`, with as many blocks as the points need.
        by_out: the gradient in the answers [N, A].
        by_points: the gradient in the points [N, V * F], filled.
    """
    most, total = 0, len(weights)
    for width in widths:
        most = max(most, width)
    if form.last == SCALED:
        total -= widths[-1]
    one, two = np.empty((most, LANES), np.float32), np.empty((most, LANES), np.float32)
    work = np.empty((2 * form.features + 4 * form.width + form.pooled, LANES), np.float32)
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
            two[:inputs] = 0
            tiles.add(one[:outputs], weights, at, 1, inputs, outputs, inputs, two[:inputs], lanes)
            one, two = two, one
            row -= inputs
        if form.width:
            _encode_backward(
                points, start, count, weights, form, lanes, best[block], chosen[block], one, work, by_points
            )
        else:
            for n in range(count):
                for k in range(widths[0]):
                    by_points[start + n, k] = one[k, n]


@rounded_once
def answer_backward(
    by_out: Floats, weights: Floats, at: int, last: int, start: int, count: int, lanes: int, by_y: Floats
) -> None:
    for j in range(len(by_y)):
        for n in range(count, lanes):
            by_y[j, n] = np.float32(0)
    for n in range(count):
        if last == DUELING:
            whole = np.float32(0)
            for j in range(1, len(by_y)):
                whole += by_out[start + n, j - 1]
            by_y[0, n], mean = whole, whole / np.float32(len(by_y) - 1)
            for j in range(1, len(by_y)):
                by_y[j, n] = by_out[start + n, j - 1] - mean
        else:
            for j in range(len(by_y)):
                by_y[j, n] = by_out[start + n, j] * weights[at + j] if last == SCALED else by_out[start + n, j]


@rounded_once
def activate_backward(y: Floats, kind: int, lanes: int, by_y: Floats) -> None:
    """The gradient before an activation from that after it, in place, and its results `y`."""
    if kind == RELU:
        for j in range(len(y)):
            for n in range(lanes):
                slope, after = by_y[j, n], y[j, n]
                by_y[j, n] = slope if after > 0 else np.float32(0)
    if kind == TANH:
        for j in range(len(y)):
            for n in range(lanes):
                by_y[j, n] *= np.float32(1) - y[j, n] * y[j, n]


@rounded_once
def _encode_backward(
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
    by_points: Floats,
) -> None:
    """The gradient of a block in its points, from that in the encoder's output `by_layer` [features - 1 + pooled, lanes].

    Args:
        work: room for `2 * features + 4 * width + pooled` rows; its first ones are the ego's features and their sums (`own`).
    """
    size, width, pooled = form.features, form.width, form.pooled
    ego = width * size + width
    pair, at = ego + width * (size - 1), 0
    x, at = work[at : at + size], at + size
    by_x, at = work[at : at + size], at + size
    own, at = work[at : at + width], at + width
    hidden, at = work[at : at + width], at + width
    by_hidden, at = work[at : at + width], at + width
    by_own, at = work[at : at + width], at + width
    by_response = work[at : at + pooled]
    read(points, start, count, 1, lanes, x[: size - 1])
    fill(own, weights, width * size, lanes)
    tiles.add(x[: size - 1], weights, ego, size - 1, 1, size - 1, width, own, lanes)
    by_own[:] = 0
    for row in range(1, form.rows):
        read(points, start, count, row * size, lanes, x)
        number, asked = np.float32(row), False
        by_x[:] = 0
        for p in range(pooled):
            for n in range(lanes):
                slope, response = by_layer[size - 1 + p, n], best[p, n]
                slope = slope if (chosen[p, n] == number) & (response > 0) else np.float32(0)
                asked |= slope != 0
                by_x[0, n] += slope * response
                by_response[p, n] = slope * x[0, n]
        if not asked:
            for n in range(count):
                for k in range(size):
                    by_points[start + n, row * size + k] = np.float32(0)
            continue
        for n in range(lanes):
            # A largest response above 0 has a car that is present.
            by_x[0, n] = by_x[0, n] / x[0, n] if x[0, n] != 0 else np.float32(0)
        for j in range(width):
            for n in range(lanes):
                hidden[j, n], by_hidden[j, n] = own[j, n], np.float32(0)
        tiles.add(x, weights, 0, size, 1, size, width, hidden, lanes)
        tiles.add(by_response, weights, pair, 1, width, pooled, width, by_hidden, lanes)
        for j in range(width):
            for n in range(lanes):
                slope, before = by_hidden[j, n], hidden[j, n]
                slope = slope if before > 0 else np.float32(0)
                by_hidden[j, n] = slope
                by_own[j, n] += slope
        tiles.add(by_hidden, weights, 0, 1, size, width, size, by_x, lanes)
        for n in range(count):
            for k in range(size):
                by_points[start + n, row * size + k] = by_x[k, n]
    by_ego = by_x[: size - 1]
    for k in range(size - 1):
        for n in range(lanes):
            by_ego[k, n] = by_layer[k, n]
    tiles.add(by_own, weights, ego, 1, size - 1, width, size - 1, by_ego, lanes)
    for n in range(count):
        by_points[start + n, 0] = np.float32(0)
        for k in range(size - 1):
            by_points[start + n, 1 + k] = by_ego[k, n]
