"""What a camera's pictures may go through before a detector sees them: kornia's random transformations, with little graph.

A patch reaches a small part of a picture. The values are those of the whole, the graph is of that part only: the gradient is
the same, and the way back, twice as long as the way there, costs next to nothing.
"""

from __future__ import annotations

from typing import Literal

import torch
from kornia.augmentation import ColorJiggle, RandomAffine, RandomPerspective
from kornia.enhance import adjust_brightness, adjust_contrast, adjust_saturation
from torch import Tensor
from torch.nn.functional import grid_sample

Places = tuple[Tensor, Tensor, Tensor]
"""Number, row and column of pixels of a batch of pictures, each [N, h, w] or broadcast to it."""
Beyond = Literal["zeros", "reflection"]
"""What is outside a picture, as `grid_sample` calls it."""


class Transformations:
    """Rotation and change of size, perspective, colour and noise, drawn anew in each call; each is left out at 0.

    All that is random comes from torch's global generator, through kornia. `attacks.eot.EOT` says what the arguments are.
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

    def __call__(self, pictures: Tensor, boxes: Tensor) -> Tensor:
        """Pictures [N, 3, H, W] transformed, in [0, 1], differentiable to those of their pixels that are in `boxes` [N, 4]."""
        shape = pictures.shape
        reach = covered(boxes, shape)
        for warp, beyond in self.warps:
            matrices = warp.compute_transformation(pictures, warp.forward_parameters(shape), warp.flags)
            grid = sources(matrices, shape)
            reach = grid_sample(reach, grid, padding_mode=beyond, align_corners=False)
            places = around(reach)
            whole = grid_sample(pictures.detach(), grid, padding_mode=beyond, align_corners=False)
            patched = grid_sample(pictures, grid[places], padding_mode=beyond, align_corners=False)
            pictures = put(whole, places, patched)
        places = around(reach)
        whole, patched = pictures.detach(), cut(pictures, places)
        if self.jiggle:
            drawn = self.jiggle.forward_parameters(shape)
            whole, patched = recoloured(whole, drawn), recoloured(patched, drawn)
        if self.noise:
            noise = torch.randn(shape).mul_(self.noise)
            whole, patched = whole + noise, patched + cut(noise, places)
        return put(whole.clamp(0, 1), places, patched.clamp(0, 1))


def covered(boxes: Tensor, shape: torch.Size) -> Tensor:
    """[N, 1, H, W] 1 for the pixels of pictures [N, C, H, W] that boxes [N, 4] touch, else 0."""
    rows, columns = (torch.arange(side) for side in shape[2:])
    x0, y0, x1, y1 = boxes[:, :, None].unbind(1)
    down, across = (rows + 1 > y0) & (rows < y1), (columns + 1 > x0) & (columns < x1)
    return (down[:, :, None] & across[:, None]).float()[:, None]


def around(mask: Tensor) -> Places:
    """Rectangles of one size around what is not 0 in masks [N, 1, H, W]."""
    rows, columns = (_span(mask.amax((1, other)) > 0) for other in (3, 2))
    return torch.arange(len(mask))[:, None, None], rows[:, :, None], columns[:, None]


def _span(there: Tensor) -> Tensor:
    """[N, k] runs of places, of one length, that hold all that is True in masks [N, L]."""
    length = there.shape[1]
    first, last = there.int().argmax(1), length - 1 - there.flip(1).int().argmax(1)
    longest = int((last - first).max().clamp(min=0)) + 1
    return first.clamp(max=length - longest)[:, None] + torch.arange(longest)


def cut(pictures: Tensor, places: Places) -> Tensor:
    """[N, C, h, w] the pixels of pictures [N, C, H, W] at places."""
    return pictures.movedim(1, -1)[places].movedim(-1, 1)


def put(pictures: Tensor, places: Places, part: Tensor) -> Tensor:
    """The pictures [N, C, H, W], with `part` [N, C, h, w] written into them."""
    pictures.movedim(1, -1)[places] = part.movedim(1, -1)
    return pictures


def sources(matrices: Tensor, shape: torch.Size) -> Tensor:
    """[N, H, W, 2] where the pixels of pictures come from that homographies [N, 3, 3] move, in `grid_sample`'s units."""
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
    """What kornia's ColorJiggle makes of pictures with the factors and in the order that it drew; a neutral step is left out."""
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
    """Pictures [N, 3, H, W] with their hue (of HSV) turned by shares of the circle [N]: kornia's adjust_hue, several times faster."""
    most, least = pictures.amax(1, keepdim=True), pictures.amin(1, keepdim=True)
    chroma = most - least
    red, green, blue = pictures.split(1, 1)
    # In sixths of the circle, hue is 1 + (green + blue - red - least) / chroma where green is not less than blue; else it is
    # the mirror image of that.
    far = 2 - (green + blue - red - least) / chroma.clamp(min=torch.finfo(chroma.dtype).tiny)
    hue = (3 - far.copysign(green - blue) + 6 * turn[:, None, None, None]).remainder(6)
    # A channel is at its most within 1 of its own hue, and at its least beyond 2.
    away = (hue - torch.tensor([0.0, 2.0, 4.0])[:, None, None]).abs()
    return torch.addcmul(least - chroma, chroma, (away - 3).abs().clamp(1, 2))
