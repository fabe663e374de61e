"""A small U-Net that marks pixels of patches."""

from __future__ import annotations

from itertools import pairwise

from torch import Tensor, cat, nn

WIDTHS = (16, 32, 48)
"""Channels at half, a quarter and an eighth of the image's resolution."""


class Marker(nn.Module):
    """Log-odds that a pixel belongs to a patch: a U-Net (Ronneberger et al. 2015) as in SAC, at half resolution.

    Images [N, 3, H, W] in [0, 1] become log-odds [N, 1, ceil(H / 2), ceil(W / 2)]. It has 94,481 weights.
    """

    def __init__(self) -> None:
        super().__init__()
        self.first = _block(12, WIDTHS[0])
        self.down = nn.ModuleList(_block(a, b) for a, b in pairwise(WIDTHS))
        self.up = nn.ModuleList(_block(a + b, a) for a, b in pairwise(WIDTHS))
        self.last = nn.Conv2d(WIDTHS[0], 1, 1)

    def forward(self, pictures: Tensor) -> Tensor:
        height, width = pictures.shape[2:]
        whole = nn.functional.pad(pictures, (0, -width % 8, 0, -height % 8), mode="replicate")
        x = self.first(nn.functional.pixel_unshuffle(whole, 2))
        passed = []
        for block in self.down:
            passed.append(x)
            x = block(nn.functional.max_pool2d(x, 2))
        for block, beside in zip(reversed(self.up), reversed(passed), strict=True):
            x = block(cat((nn.functional.interpolate(x, scale_factor=2.0), beside), 1))
        return self.last(x)[:, :, : (height + 1) // 2, : (width + 1) // 2]


def _block(inputs: int, outputs: int) -> nn.Sequential:
    """Two 3 x 3 convolutions with batch normalisation."""
    layers: list[nn.Module] = []
    for a, b in ((inputs, outputs), (outputs, outputs)):
        layers += [nn.Conv2d(a, b, 3, padding=1, bias=False), nn.BatchNorm2d(b), nn.ReLU()]
    return nn.Sequential(*layers)
