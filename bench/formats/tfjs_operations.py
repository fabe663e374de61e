"""The operations of TensorFlow that a graph of TensorFlow.js may have, carried out by torch. Images are [N, H, W, C].

Each takes the node and its values, and returns one tensor or a tuple. What could become large asks for `room` before it is made.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from cavbench.formats.tfjs_file import Node, number, texts, whole, wholes, yes
from cavbench.formats.tfjs_images import average_pool, convolution, depthwise, max_pool, resize_bilinear, resize_nearest
from cavbench.formats.tfjs_room import room
from cavbench.formats.trial import RefusedError

Operation = Callable[..., Any]
"""(node, *values) -> a tensor, or a tuple of tensors."""
DTYPES = {
    "DT_FLOAT": torch.float32, "DT_HALF": torch.float32, "DT_INT32": torch.int64, "DT_INT64": torch.int64, "DT_BOOL": torch.bool,
    "DT_UINT8": torch.int64,
}  # fmt: skip
ACTIVATIONS: Mapping[str, Callable[[Tensor], Tensor]] = {
    "Relu": torch.relu,
    "Relu6": nn.functional.relu6,
    "Elu": nn.functional.elu,
    "Sigmoid": torch.sigmoid,
    "Tanh": torch.tanh,
}


def _each(call: Callable[[Tensor], Tensor]) -> Operation:
    return lambda node, x: call(x)


def _both(call: Callable[[Any, Any], Any]) -> Operation:
    def run(node: Node, a: Tensor, b: Tensor) -> Any:
        room(torch.broadcast_shapes(a.shape, b.shape))
        return call(a, b)

    return run


def _divided(a: Tensor, b: Tensor) -> Tensor:
    return a / b if a.is_floating_point() else torch.div(a, b, rounding_mode="trunc")


def _over(call: Callable[..., Any]) -> Operation:
    """A reduction over the axes that the second value names."""

    def run(node: Node, x: Tensor, axes: Tensor) -> Any:
        named = [one % x.ndim for one in axes.reshape(-1).tolist()]
        kept = yes(node.attributes.get("keep_dims"))
        return call(x, dim=named, keepdim=kept) if named else x

    return run


def _fused(convolve: Operation) -> Operation:
    """A convolution or a product with what follows it: a bias and an activation."""

    def run(node: Node, x: Tensor, kernel: Tensor, *others: Tensor) -> Tensor:
        found, left = convolve(node, x, kernel), list(others)
        for word in texts(node.attributes.get("fused_ops")):
            if word == "BiasAdd" and left:
                found = found + left.pop(0)
            elif word == "LeakyRelu":
                found = nn.functional.leaky_relu(found, number(node.attributes.get("leakyrelu_alpha"), 0.2))
            elif word == "Prelu" and left:
                found = torch.where(found >= 0, found, found * left.pop(0))
            elif word in ACTIVATIONS:
                found = ACTIVATIONS[word](found)
            else:
                raise RefusedError(f"its node {node.name!r} is fused with {word!r}, which is not read")
        return found

    return run


def _product(node: Node, a: Tensor, b: Tensor) -> Tensor:
    a = a.mT if yes(node.attributes.get("transpose_a") or node.attributes.get("adj_x")) else a
    b = b.mT if yes(node.attributes.get("transpose_b") or node.attributes.get("adj_y")) else b
    room((*torch.broadcast_shapes(a.shape[:-2], b.shape[:-2]), a.shape[-2], b.shape[-1]))
    return a @ b


def _normalised(node: Node, x: Tensor, scale: Tensor, offset: Tensor, mean: Tensor, variance: Tensor) -> Tensor:
    return (x - mean) * (variance + number(node.attributes.get("epsilon"), 1e-3)).rsqrt() * scale + offset


def _padded(node: Node, x: Tensor, pads: Tensor, value: Tensor | None = None) -> Tensor:
    sides = pads.tolist()
    if len(sides) != x.ndim or any(one < 0 for side in sides for one in side):
        raise RefusedError(f"its node {node.name!r} pads by {sides}")
    room(size + sum(side) for size, side in zip(x.shape, sides, strict=True))
    flat = [one for side in reversed(sides) for one in side]
    return nn.functional.pad(x, flat, value=0.0 if value is None else float(value))


def _mirrored(node: Node, x: Tensor, pads: Tensor) -> Tensor:
    (first, *middle, last) = pads.tolist()
    if x.ndim != 4 or any((*first, *last)) or texts(node.attributes.get("mode")) != ["REFLECT"]:
        raise RefusedError(f"its node {node.name!r} mirrors more than the border of images")
    (top, bottom), (left, right) = middle
    room((x.shape[0], x.shape[1] + top + bottom, x.shape[2] + left + right, x.shape[3]))
    return nn.functional.pad(x.permute(0, 3, 1, 2), (left, right, top, bottom), mode="reflect").permute(0, 2, 3, 1)


def _reshaped(node: Node, x: Tensor, shape: Tensor) -> Tensor:
    return x.reshape(shape.tolist())


def _squeezed(node: Node, x: Tensor) -> Tensor:
    axes = [one % x.ndim for one in wholes(node.attributes.get("squeeze_dims") or node.attributes.get("axis"))]
    return x.squeeze(tuple(axes or [axis for axis, side in enumerate(x.shape) if side == 1]))


def _joined(node: Node, *values: Tensor) -> Tensor:
    (*parts, axis) = values
    room((len(parts), max(part.numel() for part in parts)))
    return torch.cat(parts, int(axis))


def _packed(node: Node, *values: Tensor) -> Tensor:
    room((len(values), values[0].numel()))
    return torch.stack(values, whole(node.attributes.get("axis")))


def _split(node: Node, axis: Tensor, x: Tensor) -> tuple[Tensor, ...]:
    return tuple(x.tensor_split(_several(node, whole(node.attributes.get("num_split"), 1)), int(axis)))


def _split_by(node: Node, x: Tensor, sizes: Tensor, axis: Tensor) -> tuple[Tensor, ...]:
    dim, listed = int(axis), sizes.tolist()
    if listed.count(-1) == 1:
        listed[listed.index(-1)] = x.shape[dim] - sum(listed) - 1
    return tuple(x.split(listed, dim))


def _several(node: Node, count: int) -> int:
    if not 0 < count <= 1024:
        raise RefusedError(f"its node {node.name!r} has {count} parts")
    return count


def _sliced(node: Node, x: Tensor, begin: Tensor, size: Tensor) -> Tensor:
    for axis, (start, count) in enumerate(zip(begin.tolist(), size.tolist(), strict=True)):
        x = x.narrow(axis, start, x.shape[axis] - start if count == -1 else count)
    return x


def _strided(node: Node, x: Tensor, begin: Tensor, end: Tensor, strides: Tensor) -> Tensor:
    masks = {
        name: whole(node.attributes.get(f"{name}_mask"))
        for name in ("begin", "end", "ellipsis", "new_axis", "shrink_axis")
    }
    places: list[Any] = []
    for axis, (start, stop, step) in enumerate(zip(begin.tolist(), end.tolist(), strides.tolist(), strict=True)):
        if masks["ellipsis"] >> axis & 1:
            places.append(...)
        elif masks["new_axis"] >> axis & 1:
            places.append(None)
        elif masks["shrink_axis"] >> axis & 1:
            places.append(start)
        else:
            first = None if masks["begin"] >> axis & 1 else start
            last = None if masks["end"] >> axis & 1 else stop
            places.append(slice(first, last, step))
    if any(isinstance(one, slice) and one.step < 1 for one in places):
        raise RefusedError(f"its node {node.name!r} slices backwards")
    return x[tuple(places)]


def _gathered(node: Node, x: Tensor, index: Tensor, axis: Tensor | None = None) -> Tensor:
    if whole(node.attributes.get("batch_dims")):
        raise RefusedError(f"its node {node.name!r} gathers by images")
    dim = int(axis) % x.ndim if axis is not None else 0
    shape = (*x.shape[:dim], *index.shape, *x.shape[dim + 1 :])
    room(shape)
    return x.index_select(dim, index.reshape(-1)).reshape(shape)


def _best(node: Node, x: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
    # Of equal values, TensorFlow takes the one with the lower number.
    values, places = x.sort(dim=-1, descending=True, stable=True)
    return values[..., : int(count)], places[..., : int(count)]


def _tiled(node: Node, x: Tensor, times: Tensor) -> Tensor:
    room(side * time for side, time in zip(x.shape, times.tolist(), strict=True))
    return x.repeat(times.tolist())


def _filled(node: Node, shape: Tensor, value: Tensor) -> Tensor:
    room(shape.tolist())
    return value.expand(shape.tolist()).clone()


def _range(node: Node, start: Tensor, stop: Tensor, step: Tensor) -> Tensor:
    if not float(step) or not math.isfinite(float(step)):
        raise RefusedError(f"its node {node.name!r} counts by {float(step)}")
    room((max(0, math.ceil((float(stop) - float(start)) / float(step))),))
    return torch.arange(start.item(), stop.item(), step.item(), device=start.device)


def _dense(node: Node, places: Tensor, shape: Tensor, values: Tensor, rest: Tensor) -> Tensor:
    room(shape.tolist())
    found = rest.expand(shape.tolist()).clone()
    if values.numel():
        found[tuple(places.reshape(-1, found.ndim).T)] = values
    return found


def _chosen(node: Node, where: Tensor, a: Tensor, b: Tensor) -> Tensor:
    room(torch.broadcast_shapes(where.shape, a.shape, b.shape))
    return torch.where(where, a, b)


def _cast(node: Node, x: Tensor) -> Tensor:
    kind = str((node.attributes.get("DstT") or {}).get("type"))
    if kind not in DTYPES:
        raise RefusedError(f"its node {node.name!r} makes {kind}, which is not read")
    return x.to(DTYPES[kind])


def _most(node: Node, x: Tensor, axis: Tensor) -> Tensor:
    return x.argmax(int(axis))


def _leaky(node: Node, x: Tensor) -> Tensor:
    return nn.functional.leaky_relu(x, number(node.attributes.get("alpha"), 0.2))


def _dimension(node: Node, x: Tensor, axis: Tensor) -> Tensor:
    return x.unsqueeze(int(axis))


def _transposed(node: Node, x: Tensor, order: Tensor) -> Tensor:
    return x.permute(order.tolist())


def _unpacked(node: Node, x: Tensor) -> tuple[Tensor, ...]:
    _several(node, x.shape[whole(node.attributes.get("axis"))])
    return x.unbind(whole(node.attributes.get("axis")))


def _shape(node: Node, x: Tensor) -> Tensor:
    return torch.tensor(x.shape, device=x.device)


def _same(node: Node, x: Tensor, *others: Tensor) -> Tensor:
    return x


EACH: Mapping[str, Callable[[Tensor], Tensor]] = {
    **ACTIVATIONS, "Softplus": nn.functional.softplus, "Selu": nn.functional.selu, "Exp": torch.exp, "Log": torch.log,
    "Sqrt": torch.sqrt, "Rsqrt": torch.rsqrt, "Square": torch.square, "Neg": torch.neg, "Abs": torch.abs, "Floor": torch.floor,
    "Ceil": torch.ceil, "Round": torch.round, "ZerosLike": torch.zeros_like, "OnesLike": torch.ones_like,
    "LogicalNot": torch.logical_not, "Reciprocal": torch.reciprocal,
}  # fmt: skip
BOTH: Mapping[str, Callable[[Any, Any], Any]] = {
    "Add": operator.add, "AddV2": operator.add, "BiasAdd": operator.add, "Sub": operator.sub, "Mul": operator.mul,
    "RealDiv": _divided, "Div": _divided, "FloorDiv": torch.floor_divide, "FloorMod": torch.remainder, "Maximum": torch.maximum,
    "Minimum": torch.minimum, "Pow": torch.pow, "SquaredDifference": lambda a, b: (a - b) ** 2, "Equal": torch.eq,
    "NotEqual": torch.ne, "Greater": torch.gt, "GreaterEqual": torch.ge, "Less": torch.lt, "LessEqual": torch.le,
    "LogicalAnd": torch.logical_and, "LogicalOr": torch.logical_or, "Prelu": lambda x, slope: torch.where(x >= 0, x, x * slope),
}  # fmt: skip
OVER: Mapping[str, Callable[..., Any]] = {
    "Mean": torch.mean, "Sum": torch.sum, "Max": torch.amax, "Min": torch.amin, "All": torch.all, "Any": torch.any,
}  # fmt: skip
OPERATIONS: Mapping[str, Operation] = {
    **dict.fromkeys(("Identity", "StopGradient", "PreventGradient", "CheckNumerics"), _same),
    **{name: _each(call) for name, call in EACH.items()},
    **{name: _both(call) for name, call in BOTH.items()},
    **{name: _over(call) for name, call in OVER.items()},
    "Softmax": lambda node, x: x.softmax(-1), "LeakyRelu": _leaky, "Conv2D": convolution, "_FusedConv2D": _fused(convolution),
    "DepthwiseConv2dNative": depthwise, "FusedDepthwiseConv2dNative": _fused(depthwise), "MatMul": _product,
    "_FusedMatMul": _fused(_product), "BatchMatMulV2": _product, "FusedBatchNorm": _normalised, "FusedBatchNormV3": _normalised,
    "MaxPool": max_pool, "AvgPool": average_pool, "ResizeBilinear": resize_bilinear, "ResizeNearestNeighbor": resize_nearest,
    "Pad": _padded, "PadV2": _padded, "MirrorPad": _mirrored, "Reshape": _reshaped, "Squeeze": _squeezed, "Cast": _cast,
    "ExpandDims": _dimension, "Transpose": _transposed, "ConcatV2": _joined, "Pack": _packed, "Unpack": _unpacked,
    "Split": _split, "SplitV": _split_by, "Slice": _sliced, "StridedSlice": _strided, "GatherV2": _gathered, "TopKV2": _best,
    "Tile": _tiled, "Fill": _filled, "Range": _range, "SparseToDense": _dense, "Select": _chosen, "SelectV2": _chosen,
    "ArgMax": _most, "Shape": _shape,
}  # fmt: skip
"""By their names. `Const` and `Placeholder` are values that the graph is given."""


def operation(node: Node) -> Operation:
    """The operation of a node.

    Raises:
        RefusedError: if it is not one of `OPERATIONS`.
    """
    if node.operation not in OPERATIONS:
        raise RefusedError(
            f"its node {node.name[:60]!r} has the operation {node.operation[:60]!r}; {len(OPERATIONS)} operations are "
            "read, those of cavbench.formats.tfjs_operations"
        )
    return OPERATIONS[node.operation]


def parts(found: Any) -> Sequence[Tensor]:
    """The results of an operation."""
    return found if isinstance(found, tuple) else (found,)
