"""Random transformations of camera images, with kornia's parameters, and gradients only where they are needed.

A patch changes a small part of an image. The whole image is transformed without a graph, and only this part with a graph. The
gradient is the same, and the backward pass, otherwise twice as slow as the forward pass, costs almost nothing.
"""

from __future__ import annotations

from typing import Literal

import torch
from kornia.augmentation import ColorJiggle, RandomAffine, RandomPerspective
from kornia.enhance import adjust_brightness, adjust_contrast, adjust_saturation
from kornia.geometry.linalg import transform_points
from torch import Tensor
from torch.nn.functional import grid_sample

Places = tuple[Tensor, Tensor, Tensor]
"""Image index, row and column of pixels in a batch of images, each [N, h, w] or broadcast to it."""
Beyond = Literal["zeros", "reflection"]
"""Padding outside the image, as named by `grid_sample`."""


class Transformations:
    """Random rotation and scale, perspective, colour and noise, drawn in each call; 0 disables a transformation.

    kornia draws from torch's global generator. `cavbench.attacks.detection.eot.EOT` documents the arguments.
    """

    def __init__(
        self,
        *,
        rotation: float,
        scale: float,
        perspective: float,
        brightness: float,
        contrast: float,
        saturation: float,
        hue: float,
        noise: float,
    ) -> None:
        self.warps: list[tuple[RandomAffine | RandomPerspective, Beyond]] = []
        if rotation or scale:
            sizes = (1 - scale, 1 + scale) if scale else None
            self.warps.append((RandomAffine(rotation, scale=sizes, p=1.0), "reflection"))
        if perspective:
            self.warps.append((RandomPerspective(perspective, p=1.0), "zeros"))
        coloured = brightness or contrast or saturation or hue
        self.jiggle = ColorJiggle(brightness, contrast, saturation, hue, p=1.0) if coloured else None
        self.noise = noise
        self._matrices: list[Tensor] = []

    def carried(self, boxes: Tensor) -> Tensor:
        """Boxes [N, 4] of the images of the last call, around where its warps have moved them."""
        corners = boxes[:, [0, 1, 2, 1, 2, 3, 0, 3]].unflatten(1, (4, 2))
        for matrices in self._matrices:
            corners = transform_points(matrices, corners)
        return torch.cat((corners.amin(1), corners.amax(1)), 1)

    def __call__(self, pictures: Tensor, boxes: Tensor) -> Tensor:
        """Transform images [N, 3, H, W] in [0, 1]; differentiable in the pixels inside `boxes` [N, 4]."""
        shape = pictures.shape
        self._matrices = []
        if not (self.warps or self.jiggle or self.noise):
            return pictures
        for warp, beyond in self.warps:
            matrices = warp.compute_transformation(pictures, warp.forward_parameters(shape), warp.flags)
            self._matrices.append(matrices)
            grid = sources(matrices, shape)
            boxes = moved(mirrored(boxes, grid) if beyond == "reflection" else boxes[:, None], matrices, shape)
            places = around(boxes, shape)
            whole = grid_sample(pictures.detach(), grid, padding_mode=beyond, align_corners=False)
            patched = grid_sample(pictures, grid[places], padding_mode=beyond, align_corners=False)
            pictures = put(whole, places, patched)
        places = around(boxes, shape)
        whole, patched = pictures.detach(), cut(pictures, places)
        if self.jiggle:
            drawn = self.jiggle.forward_parameters(shape)
            whole, patched = recoloured(whole, drawn), recoloured(patched, drawn)
        if self.noise:
            noise = torch.randn(shape).mul_(self.noise)
            whole, patched = whole + noise, patched + cut(noise, places)
        return put(whole.clamp(0, 1), places, patched.clamp(0, 1))


def mirrored(boxes: Tensor, grid: Tensor) -> Tensor:
    """Boxes [N, B, 4] of all mirror images of a box [N, 4], reflected at the image borders, as far as a grid reaches."""
    height, width = grid.shape[1:3]
    farthest = grid[:, [0, 0, -1, -1], [0, -1, 0, -1]].abs().max()
    times = max(0, int(((farthest - 1) / 2).ceil()))

    def images(edges: Tensor, side: int) -> Tensor:
        flipped = edges.flip(-1)
        copies = [(n + 1) * side - flipped if n % 2 else n * side + edges for n in range(-times, times + 1)]
        return torch.stack(copies, 1)

    x, y = images(boxes[:, 0::2], width), images(boxes[:, 1::2], height)
    return torch.stack(torch.broadcast_tensors(x[:, :, None], y[:, None]), -1).flatten(-2).flatten(1, 2)


def moved(boxes: Tensor, matrices: Tensor, shape: torch.Size) -> Tensor:
    """Boxes [N, 4] around all pixels that depend on boxes [N, B, 4] after warping the images by homographies [N, 3, 3]."""
    # Bilinear sampling reads pixels less than 1 away; the homography's coordinates are 0 in the middle of a pixel.
    wider = boxes + torch.tensor([-1.0, -1.0, 0.0, 0.0])
    corners = wider[..., [0, 1, 2, 1, 2, 3, 0, 3]].unflatten(-1, (-1, 2))
    seen = transform_points(matrices, corners.flatten(1, 2)).unflatten(1, corners.shape[1:3])
    end = torch.tensor([shape[3], shape[2]])
    low, high = seen.amin(2).floor().clamp(min=0), (seen.amax(2).ceil() + 1).minimum(end)
    inside = (low < high).all(-1, keepdim=True)
    return torch.cat((low.where(inside, end).amin(1), high.where(inside, 0).amax(1)), -1)


def around(boxes: Tensor, shape: torch.Size) -> Places:
    """Pixels of equal-sized rectangles around boxes [N, 4], within images [N, 3, H, W]."""
    end = torch.tensor([shape[3], shape[2]])
    low, high = (boxes[:, :2].floor().clamp(min=0), boxes[:, 2:].ceil().minimum(end))
    size = (high - low).amax(0).clamp(min=1)
    columns, rows = (
        first[:, None] + torch.arange(int(count))
        for first, count in zip(low.minimum(end - size).long().T, size, strict=True)
    )
    return torch.arange(len(boxes))[:, None, None], rows[:, :, None], columns[:, None]


def cut(pictures: Tensor, places: Places) -> Tensor:
    """[N, 3, h, w] the pixels of images [N, 3, H, W] at `places`."""
    return pictures[_in_every_channel(places)]


def put(pictures: Tensor, places: Places, part: Tensor) -> Tensor:
    """Write `part` [N, 3, h, w] into images [N, 3, H, W], in place, and return them."""
    return pictures.index_put_(_in_every_channel(places), part)


def _in_every_channel(places: Places) -> tuple[Tensor, ...]:
    number, rows, columns = (place[:, None] for place in places)
    return number, torch.arange(3)[:, None, None], rows, columns


def sources(matrices: Tensor, shape: torch.Size) -> Tensor:
    """[N, H, W, 2] sampling grid for warping images by homographies [N, 3, 3], in `grid_sample`'s units."""
    number, _, height, width = shape
    unit = torch.tensor([[2 / width, 0, 1 / width - 1], [0, 2 / height, 1 / height - 1], [0, 0, 1]])
    back = (unit @ matrices.inverse())[..., None, None]
    x, y = torch.arange(width), torch.arange(height)[:, None]
    *place, scale = (back[:, row, 0] * x + (back[:, row, 1] * y + back[:, row, 2]) for row in range(3))
    grid = torch.empty(number, height, width, 2)
    for axis in (0, 1):
        torch.div(place[axis], scale, out=grid[..., axis])
    return grid


def recoloured(pictures: Tensor, drawn: dict[str, Tensor]) -> Tensor:
    """kornia's ColorJiggle with the factors and order that it drew; neutral steps are skipped."""
    steps = (
        ("brightness", 1, lambda shown, factor: adjust_brightness(shown, factor - 1)),
        ("contrast", 1, adjust_contrast),
        ("saturation", 1, adjust_saturation),
        ("hue", 0, turned),
    )
    for number in drawn["order"].tolist():
        name, neutral, adjust = steps[number]
        factor = drawn[f"{name}_factor"]
        if (factor != neutral).any():
            pictures = adjust(pictures, factor)
    return pictures


def turned(pictures: Tensor, turn: Tensor) -> Tensor:
    """Rotate the HSV hue of images [N, 3, H, W] by shares of the full circle [N].

    The same as kornia's adjust_hue, but without the conversion to HSV, which is five times as slow.
    """
    most, least = pictures.amax(1, keepdim=True), pictures.amin(1, keepdim=True)
    chroma = most - least
    red, green, blue = pictures.split(1, 1)
    # In sixths of the circle, the hue is 1 + (green + blue - red - least) / chroma if green >= blue; otherwise it is the mirror
    # image of this.
    far = 2 - (green + blue - red - least) / chroma.clamp(min=torch.finfo(chroma.dtype).tiny)
    hue = (3 - far.copysign(green - blue) + 6 * turn[:, None, None, None]).remainder(6)
    # A channel is largest within 1 of its own hue, and smallest beyond 2.
    away = (hue - torch.tensor([0.0, 2.0, 4.0])[:, None, None]).abs()
    return torch.addcmul(least - chroma, chroma, (away - 3).abs().clamp(1, 2))
