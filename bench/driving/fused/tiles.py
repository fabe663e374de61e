"""Products of matrices in tiles that stay in registers, for `kernels`: what LLVM does not find by itself.

numba has no vectors, so the loops are written in LLVM's own language. Each sum has the order and the rounding of
`kernels.add`: the inputs one after the other, each product and its sum rounded once where the processor can.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.core import cgutils, types
from numba.extending import intrinsic
from numba.np.arrayobj import make_array
from numpy.typing import NDArray

from cavbench.compiled import rounded_once

WIDTH, HEIGHT = 16, 8
"""Points and outputs in a tile: eight vectors of the largest registers, so that a sum is ready when its next term is."""

ir = cgutils.ir
"""LLVM's language, of the version that numba itself writes."""
_VECTOR = ir.VectorType(ir.FloatType(), WIDTH)
_SIZE = ir.IntType(64)
_ZERO = ir.Constant(_VECTOR, [0.0] * WIDTH)

Floats = NDArray[np.float32]
Sizes = NDArray[np.int64]


class _Rows:
    """The rows of a two-dimensional array of float32, whose values lie side by side."""

    def __init__(self, context: Any, builder: Any, kind: Any, value: Any) -> None:
        array = make_array(kind)(context, builder, value)
        self.builder = builder
        self.data = builder.bitcast(array.data, ir.IntType(8).as_pointer())
        self.stride = builder.extract_value(array.strides, 0)

    def at(self, row: Any, place: Any) -> Any:
        """A pointer to `WIDTH` values of a row, from a place on."""
        build = self.builder
        offset = build.add(build.mul(row, self.stride), build.mul(place, _SIZE(4)))
        return build.bitcast(build.gep(self.data, [offset]), _VECTOR.as_pointer())

    def load(self, row: Any, place: Any) -> Any:
        return self.builder.load(self.at(row, place), align=4)


def _flat(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    """A pointer to the first value of an array."""
    return make_array(kind)(context, builder, value).data


@intrinsic
def _used(context: Any, x: Any, inputs: Any, start: Any, used: Any) -> Any:
    """How many of the first rows of x are not 0 at all of the `WIDTH` points from `start` on; fills `used` with their numbers."""

    def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        rows, numbers = _Rows(context, builder, x, given[0]), _flat(context, builder, used, given[3])
        count = cgutils.alloca_once_value(builder, _SIZE(0))
        with cgutils.for_range(builder, given[1]) as loop:
            other = builder.fcmp_unordered("!=", rows.load(loop.index, given[2]), _ZERO)
            some = builder.icmp_unsigned("!=", builder.bitcast(other, ir.IntType(WIDTH)), ir.IntType(WIDTH)(0))
            at = builder.load(count)
            builder.store(loop.index, builder.gep(numbers, [at]))
            builder.store(builder.add(at, builder.zext(some, _SIZE)), count)
        return builder.load(count)

    return types.int64(x, types.int64, types.int64, used), build


def _tile(height: int, *, rectified: bool) -> Any:
    """The intrinsic that adds to a tile of so many outputs; what is below 0 becomes 0 if it is `rectified`."""

    @intrinsic
    def add(
        context: Any,
        x: Any,
        start: Any,
        used: Any,
        count: Any,
        weights: Any,
        at: Any,
        across: Any,
        along: Any,
        first: Any,
        y: Any,
        j: Any,
    ) -> Any:
        def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
            shown, start, numbers, count, factors, at, across, along, begun, sums, j = given
            rows, results = _Rows(context, builder, x, shown), _Rows(context, builder, y, sums)
            before = _Rows(context, builder, first, begun)
            numbers, factors = _flat(context, builder, used, numbers), _flat(context, builder, weights, factors)
            wide = ir.FunctionType(_VECTOR, [_VECTOR] * 3)
            once = cgutils.get_or_insert_function(builder.module, wide, f"llvm.fmuladd.v{WIDTH}f32")
            same = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)
            places = [builder.add(j, _SIZE(number)) for number in range(height)]
            held = [cgutils.alloca_once_value(builder, before.load(place, start)) for place in places]
            firsts = [builder.add(at, builder.mul(place, across)) for place in places]
            with cgutils.for_range(builder, count) as loop:
                k = builder.load(builder.gep(numbers, [loop.index]))
                values, step = rows.load(k, start), builder.mul(k, along)
                for place, sum_ in zip(firsts, held, strict=True):
                    factor = builder.load(builder.gep(factors, [builder.add(place, step)]))
                    spread = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), factor, ir.IntType(32)(0))
                    spread = builder.shuffle_vector(spread, ir.Constant(_VECTOR, ir.Undefined), same)
                    builder.store(builder.call(once, [spread, values, builder.load(sum_)]), sum_)
            for place, sum_ in zip(places, held, strict=True):
                found = builder.load(sum_)
                if rectified:
                    found = builder.select(builder.fcmp_ordered("<", found, _ZERO), _ZERO, found)
                builder.store(found, results.at(place, start), align=4)
            return context.get_dummy_value()

        number = types.int64
        return types.void(x, number, used, number, weights, number, number, number, first, y, number), build

    return add


_high, _low = _tile(HEIGHT, rectified=False), _tile(1, rectified=False)
_high_rectified, _low_rectified = _tile(HEIGHT, rectified=True), _tile(1, rectified=True)


@intrinsic
def pool(context: Any, response: Any, present: Any, start: Any, number: Any, best: Any, chosen: Any, p: Any) -> Any:
    """Compare a response of the car `number` with the largest one before it, at the points of a tile.

    The response counts times the first row of `present`. Where it is larger, or NaN, it becomes the largest one, `best`, and
    its car the `chosen` one.
    """

    def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        kinds = (response, present, best, chosen)
        arrays = (given[0], given[1], given[4], given[5])
        responses, there, most, whose = (
            _Rows(context, builder, kind, array) for kind, array in zip(kinds, arrays, strict=True)
        )
        start, p = given[2], given[6]
        found = builder.fmul(responses.load(p, start), there.load(_SIZE(0), start))
        before = most.load(p, start)
        larger = builder.or_(builder.fcmp_ordered(">", found, before), builder.fcmp_unordered("!=", found, found))
        spread = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), given[3], ir.IntType(32)(0))
        same = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)
        spread = builder.shuffle_vector(spread, ir.Constant(_VECTOR, ir.Undefined), same)
        builder.store(builder.select(larger, found, before), most.at(p, start), align=4)
        builder.store(builder.select(larger, spread, whose.load(p, start)), whose.at(p, start), align=4)
        return context.get_dummy_value()

    number_kind = types.float32
    return types.void(response, present, types.int64, number_kind, best, chosen, types.int64), build


@rounded_once
def part(
    x: Floats,
    weights: Floats,
    at: int,
    by_output: int,
    by_input: int,
    inputs: int,
    outputs: int,
    first: Floats,
    y: Floats,
    start: int,
    used: Sizes,
    rectified: bool,
) -> None:
    """y = first + w @ x, as `add`, at the `WIDTH` points from `start` on, and without what is below 0 if it is `rectified`.

    Args:
        first: what each sum begins with, as y.
        used: room for one number more than there are inputs.
    """
    whole = outputs - outputs % HEIGHT
    count = _used(x, inputs, start, used)
    if rectified:
        for j in range(0, whole, HEIGHT):
            _high_rectified(x, start, used, count, weights, at, by_output, by_input, first, y, j)
        for j in range(whole, outputs):
            _low_rectified(x, start, used, count, weights, at, by_output, by_input, first, y, j)
    else:
        for j in range(0, whole, HEIGHT):
            _high(x, start, used, count, weights, at, by_output, by_input, first, y, j)
        for j in range(whole, outputs):
            _low(x, start, used, count, weights, at, by_output, by_input, first, y, j)


@rounded_once
def empty(x: Floats, start: int, used: Sizes) -> bool:
    """Whether the first row of x is 0 at all of the `WIDTH` points from `start` on; `used` has room for two numbers."""
    return _used(x, 1, start, used) == 0


@rounded_once
def add(
    x: Floats, weights: Floats, at: int, by_output: int, by_input: int, inputs: int, outputs: int, y: Floats, lanes: int
) -> None:
    """As `kernels.add`, for a multiple of `WIDTH` lanes.

    An input that is 0 at all points of a tile changes no sum and is left out: after a ReLU half of them, where the points are
    near each other, as those of a belief are.
    """
    used = np.empty(inputs + 1, np.int64)
    for start in range(0, lanes, WIDTH):
        part(x, weights, at, by_output, by_input, inputs, outputs, y, y, start, used, False)
