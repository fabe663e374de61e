"""Convolution, pooling and resizing of images [N, H, W, C] as TensorFlow does them: its SAME pads more below and to the right."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from cavbench.formats.tfjs_file import Node, texts, wholes, yes
from cavbench.formats.tfjs_room import room
from cavbench.formats.trial import RefusedError


def convolution(node: Node, x: Tensor, kernel: Tensor) -> Tensor:
    """Conv2D of images with a kernel [h, w, inputs, outputs]; with fewer inputs than channels, in groups."""
    groups = x.shape[3] // kernel.shape[2] if kernel.shape[2] else 1
    return _convolved(node, x, kernel.permute(3, 2, 0, 1), groups)


def depthwise(node: Node, x: Tensor, kernel: Tensor) -> Tensor:
    """Depthwise convolution with a kernel [h, w, channels, times]."""
    height, width, channels, times = kernel.shape
    return _convolved(node, x, kernel.permute(2, 3, 0, 1).reshape(channels * times, 1, height, width), channels)


def max_pool(node: Node, x: Tensor) -> Tensor:
    """Max pooling; what lies beyond the border is no maximum."""
    size, steps = _sides(node, "ksize"), _sides(node, "strides")
    padded = _padded(node, x.permute(0, 3, 1, 2), size, steps, (1, 1), -torch.inf)
    return nn.functional.max_pool2d(padded, size, steps).permute(0, 2, 3, 1)


def average_pool(node: Node, x: Tensor) -> Tensor:
    """Average pooling; what lies beyond the border does not count."""
    size, steps = _sides(node, "ksize"), _sides(node, "strides")
    images = x.permute(0, 3, 1, 2)
    padded = _padded(node, images, size, steps, (1, 1), 0.0)
    inside = _padded(node, torch.ones_like(images[:1, :1]), size, steps, (1, 1), 0.0)
    share = nn.functional.avg_pool2d(inside, size, steps)
    return (nn.functional.avg_pool2d(padded, size, steps) / share).permute(0, 2, 3, 1)


def resize_bilinear(node: Node, x: Tensor, size: Tensor) -> Tensor:
    """Bilinear interpolation in the coordinates that the node says: half pixels, aligned corners, or neither."""
    images, sides = x.permute(0, 3, 1, 2), _size(x, size)
    if yes(node.attributes.get("align_corners")) or yes(node.attributes.get("half_pixel_centers")):
        aligned = yes(node.attributes.get("align_corners"))
        return nn.functional.interpolate(images, sides, mode="bilinear", align_corners=aligned).permute(0, 2, 3, 1)
    for axis, side in zip((2, 3), sides, strict=True):
        images = _between(images, axis, side)
    return images.permute(0, 2, 3, 1)


def resize_nearest(node: Node, x: Tensor, size: Tensor) -> Tensor:
    """The nearest pixel, in half pixels or from the upper left corner."""
    if yes(node.attributes.get("align_corners")):
        raise RefusedError(f"its node {node.name[:60]!r} aligns corners of nearest pixels, which is not read")
    mode = "nearest-exact" if yes(node.attributes.get("half_pixel_centers")) else "nearest"
    return nn.functional.interpolate(x.permute(0, 3, 1, 2), _size(x, size), mode=mode).permute(0, 2, 3, 1)


def _between(images: Tensor, axis: int, side: int) -> Tensor:
    """Linear interpolation along an axis whose pixel i lies at i times the ratio of the sides."""
    old = images.shape[axis]
    places = torch.arange(side, device=images.device) * (old / side)
    low = places.floor().long().clamp(max=old - 1)
    share = (places - low).to(images.dtype).reshape(-1, *[1] * (images.ndim - 1 - axis))
    first, second = (images.index_select(axis, one) for one in (low, (low + 1).clamp(max=old - 1)))
    return first + (second - first) * share


def _size(x: Tensor, size: Tensor) -> tuple[int, int]:
    height, width = (int(side) for side in size.tolist())
    room((x.shape[0], height, width, x.shape[3]))
    return height, width


def _convolved(node: Node, x: Tensor, kernel: Tensor, groups: int) -> Tensor:
    steps, spread = _sides(node, "strides"), _sides(node, "dilations", (1, 1))
    padded = _padded(node, x.permute(0, 3, 1, 2), kernel.shape[2:], steps, spread, 0.0)
    sides = [max(0, side - 1) // step + 1 for side, step in zip(padded.shape[2:], steps, strict=True)]
    room((x.shape[0], kernel.shape[0], *sides))
    return nn.functional.conv2d(padded, kernel, None, steps, 0, spread, groups).permute(0, 2, 3, 1)


def _padded(
    node: Node, images: Tensor, size: Sequence[int], steps: Sequence[int], spread: Sequence[int], value: float
) -> Tensor:
    """Images [N, C, H, W] with the border that the padding of the node asks for."""
    way = texts(node.attributes.get("padding"))
    if way == ["VALID"]:
        return images
    pads: list[int] = []
    if way == ["EXPLICIT"]:
        listed = wholes(node.attributes.get("explicit_paddings"))
        if len(listed) != 8 or any((*listed[:2], *listed[6:])) or min(listed) < 0:
            raise RefusedError(f"its node {node.name[:60]!r} pads by {listed}")
        pads = [*listed[4:6], *listed[2:4]]
    elif way == ["SAME"]:
        for side, width, step, wide in zip(images.shape[2:], size, steps, spread, strict=True):
            total = max((-(-side // step) - 1) * step + (width - 1) * wide + 1 - side, 0)
            pads = [total // 2, total - total // 2, *pads]
    else:
        raise RefusedError(f"its node {node.name[:60]!r} has the padding {way}")
    room((*images.shape[:2], images.shape[2] + sum(pads[2:]), images.shape[3] + sum(pads[:2])))
    return nn.functional.pad(images, pads, value=value)


def _sides(node: Node, name: str, otherwise: tuple[int, int] | None = None) -> tuple[int, int]:
    """Height and width of an attribute [1, h, w, 1]."""
    listed = wholes(node.attributes.get(name))
    if not listed and otherwise:
        return otherwise
    if len(listed) != 4 or (listed[0], listed[3]) != (1, 1) or min(listed) < 1 or max(listed) > 2**16:
        raise RefusedError(f"its node {node.name[:60]!r} has the {name} {listed}")
    if (texts(node.attributes.get("data_format")) or ["NHWC"]) != ["NHWC"]:
        raise RefusedError(f"its node {node.name[:60]!r} takes channels first, which is not read")
    return listed[1], listed[2]
