"""A judge of windows: it says whether a window shows a stop sign, and never looks at the middle of the window."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, interpolate, max_pool2d, pad
from torch.nn.utils import convert_conv2d_weight_memory_format
from torch.nn.utils.fusion import fuse_conv_bn_eval

CELL, STEP = 4, 2
"""Side of a cell in pixels, and the distance between two windows."""
ACROSS, HIDDEN = 12, 6
"""Cells across a window, and across its cover in the middle."""
WINDOW, COVER, SIGN = CELL * ACROSS, CELL * HIDDEN, 36
"""Side of a window, of its cover and of the sign in its middle, in pixels."""
WIDTHS, FEW = (24, 16, 48, 32), 4
"""Channels of the two layers of a cell and of the two layers of a window, and those of a cell at a glance."""
FINEST, COARSER, LEVELS = 0.8, 1.13, 12
"""Pixels of the image for a pixel of the finest level, the ratio of two levels, and their number: signs of 29 to 110 pixels."""
BESIDE, GREY = 8, 0.5
"""A level is continued by this many pixels of this colour on each side, for signs at the edge of the image."""
BLOCK = 4
"""Of a block of 4 x 4 windows, the best is reported."""
UNLIKELY, NEVER = 0.0, -8.0
"""Windows with lower log-odds at a glance are not looked at again, and get the second log-odds."""
AT_ONCE = 8192
"""Windows that are looked at in one go, to save memory."""


class Judge(nn.Module):
    """Log-odds that a window shows a stop sign, for all windows of images at once.

    A window is a grid of 12 x 12 cells of 4 x 4 pixels. Each cell is described on its own, and the descriptions of the 108 cells
    on the rim, three cells wide, are joined. The 36 cells in the middle have no weights: whatever is there, the answer is the
    same. No layer mixes neighbouring cells before, as in BagNets (Brendel and Bethge 2019), on which PatchGuard is built.

    To save time there are two answers, both from the rim alone: a linear one for all windows, and a better one for those that
    may show a sign. It has 86,758 weights.
    """

    rim: Tensor

    def __init__(self) -> None:
        super().__init__()
        first, second, joined, last = WIDTHS
        self.cells = nn.Sequential(
            nn.Conv2d(3, first, CELL, stride=STEP, bias=False),
            nn.BatchNorm2d(first),
            nn.ReLU(),
            nn.Conv2d(first, second, 1, bias=False),
            nn.BatchNorm2d(second),
            nn.ReLU(),
        )
        middle = slice((ACROSS - HIDDEN) // 2, (ACROSS + HIDDEN) // 2)
        rim = torch.ones(ACROSS, ACROSS, dtype=torch.bool)
        rim[middle, middle] = False
        self.register_buffer("rim", rim, persistent=False)
        self.few = nn.Conv2d(second, FEW, 1)
        self.glance = nn.Linear(FEW * int(rim.sum()), 1)
        self.joined = nn.Linear(second * int(rim.sum()), joined, bias=False)
        self.last = nn.Sequential(
            nn.BatchNorm2d(joined), nn.ReLU(), nn.Conv2d(joined, last, 1), nn.ReLU(), nn.Conv2d(last, 1, 1)
        )

    def freeze(self) -> None:
        """Prepare it for being asked, in place: eval mode, no gradients on its weights, and faster, as in `yolo.frozen`."""
        self.requires_grad_(False).eval()
        layers: list[Any] = list(self.cells)
        folded = [fuse_conv_bn_eval(layers[at], layers[at + 1]) for at in (0, 3)]
        self.cells = nn.Sequential(folded[0], layers[2], folded[1], layers[5])
        convert_conv2d_weight_memory_format(self, torch.channels_last)

    def forward(self, pictures: Tensor) -> Tensor:
        """Log-odds [N, 1, h, w] of images [N, 3, H, W] in [0, 1]; h is (H - 48) // 2 + 1, and w likewise."""
        cells = self.cells(pictures)
        likely = self._by_rows(self.few(cells)) > UNLIKELY
        odds = torch.full_like(likely, NEVER, dtype=pictures.dtype)
        found = torch.cat([self._at(cells, places) for places in likely[:, 0].nonzero().split(AT_ONCE)])
        return odds.masked_scatter(likely, found)

    def both(self, pictures: Tensor) -> tuple[Tensor, Tensor]:
        """The log-odds at a glance, and the better ones for all windows, [N, 1, h, w] each: for the training."""
        cells = self.cells(pictures)
        return self._by_rows(self.few(cells)), self.last(self._everywhere(cells))

    def _everywhere(self, cells: Tensor) -> Tensor:
        """The layer `joined` on the rim of every window: a convolution whose kernel is 0 in the middle."""
        return conv2d(cells, self._kernel(self.joined), dilation=CELL // STEP)

    def _by_rows(self, few: Tensor) -> Tensor:
        """The same for `glance`: a convolution for each row of its kernel, then their sum.

        With its single output, one convolution takes more than twice as long.
        """
        apart, (kernel,) = CELL // STEP, self._kernel(self.glance)
        rows = conv2d(few, kernel.transpose(0, 1)[:, :, None], dilation=(1, apart))
        high = few.shape[2] - apart * (ACROSS - 1)
        parts = [rows[:, row, apart * row : apart * row + high] for row in range(ACROSS)]
        return torch.stack(parts, 1).sum(1, keepdim=True) + self.glance.bias

    def _kernel(self, layer: nn.Linear) -> Tensor:
        """The weights of a layer on the rim of a window as a kernel [outputs, channels, 12, 12] that is 0 in the middle."""
        weights = layer.weight.unflatten(1, (-1, int(self.rim.sum())))
        kernel = weights.new_zeros(*weights.shape[:2], ACROSS, ACROSS)
        kernel[:, :, self.rim] = weights
        return kernel

    def _at(self, cells: Tensor, places: Tensor) -> Tensor:
        """The better log-odds [M] of windows at places [M, 3]: image, row and column."""
        image, row, column = (each[:, None] for each in places.unbind(1))
        down, across = self.rim.nonzero().mul(CELL // STEP).unbind(1)
        rims = cells.permute(0, 2, 3, 1)[image, row + down, column + across]
        joined = self.joined(rims.transpose(1, 2).flatten(1))
        odds: Tensor = self.last(joined[:, :, None, None])
        return odds.flatten()


@dataclass(frozen=True)
class Level:
    """The windows of one size in images [N, 3, H, W]; h x w of them.

    Args:
        pictures: [N, 3, h', w'], the images in this size, continued by `BESIDE` pixels.
        scale: width and height of a pixel of this size, in pixels of the image.
    """

    pictures: Tensor
    scale: tuple[float, float]

    @property
    def middles(self) -> Tensor:
        """[h, w, 2] x and y of the middle of each window, in pixels of the image."""
        rows, columns = (
            (torch.arange((side - WINDOW) // STEP + 1, device=self.pictures.device) * STEP + WINDOW / 2 - BESIDE)
            * scale
            for side, scale in zip(self.pictures.shape[2:], reversed(self.scale), strict=True)
        )
        return torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1)

    @property
    def boxes(self) -> Tensor:
        """[h, w, 4] where the sign of each window is, in pixels of the image."""
        return self._around(*(SIGN / 2 * scale for scale in self.scale))

    @property
    def covers(self) -> Tensor:
        """[h, w, 4] boxes of the image; the pixels that lie wholly inside have no influence on the answer for the window.

        A pixel of a level is a mean over the pixels of the image whose middles are nearer to its own than its width, and than 1.
        So those on the rim depend on a little of what is beside them.
        """
        return self._around(*(COVER / 2 * scale - (max(scale, 1) - scale / 2 - 0.5) for scale in self.scale))

    def _around(self, across: float, down: float) -> Tensor:
        middles = self.middles
        half = middles.new_tensor([across, down])
        return torch.cat([middles - half, middles + half], -1)


def levels(pictures: Tensor) -> Iterator[Level]:
    """The windows of images [N, 3, H, W] sRGB in [0, 1], finest first; without the sizes that have no window."""
    height, width = pictures.shape[2:]
    for number in range(LEVELS):
        scale = FINEST * COARSER**number
        size = round(height / scale), round(width / scale)
        if min(size) + 2 * BESIDE >= WINDOW:
            small = interpolate(pictures, size, mode="bilinear", antialias=True)
            yield Level(pad(small, (BESIDE,) * 4, value=GREY), (width / size[1], height / size[0]))


def best_of_blocks(odds: Tensor, boxes: Tensor) -> tuple[Tensor, Tensor]:
    """The best window of each block: log-odds [N, B], and its box [N, B, 4].

    Args:
        odds: [N, 1, h, w].
        boxes: [h, w, 4].
    """
    best, which = max_pool2d(odds, BLOCK, ceil_mode=True, return_indices=True)
    return best.flatten(1), boxes.flatten(0, 1)[which.flatten(1)]


def bound(odds: Tensor, usable: Tensor, found: Tensor) -> Tensor:
    """[N] log-odds which a block reports at least, whatever the windows show that are not usable; -inf if none is.

    Args:
        odds: [N, 1, h, w].
        usable: bool [N, h, w], windows whose answer is certain.
        found: bool [N, h, w], windows at the place of the sign. A block counts only if all of its windows are: any of
            them may be its best.
    """
    certain = odds[:, 0].masked_fill(~usable, -torch.inf)
    elsewhere = max_pool2d((~found).float()[:, None], BLOCK, ceil_mode=True)[:, 0] > 0
    return max_pool2d(certain[:, None], BLOCK, ceil_mode=True)[:, 0].masked_fill(elsewhere, -torch.inf).amax((1, 2))
