"""Filling marked pixels of an image from those around them."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d, pad

LEAST = 1e-3
"""A place with less weight than this takes its colour from the coarser level."""


def closed(log_odds: Tensor, radius: int) -> Tensor:
    """Log-odds [N, 1, H, W] of marks that are closed, so that holes of up to 2 * `radius` pixels vanish, and one pixel wider."""
    wide = max_pool2d(log_odds, 2 * radius + 3, 1, radius + 1)
    return -max_pool2d(-wide, 2 * radius + 1, 1, radius) if radius else wide


def filled(pictures: Tensor, kept: Tensor) -> Tensor:
    """Images whose colours come from the kept pixels only: push-pull interpolation (Gortler et al. 1996, "The lumigraph").

    Each level of a pyramid has the weighted mean of 2 x 2 pixels of the finer one. From the coarsest level back, a pixel with
    weight w becomes w times its own colour plus 1 - w times the colour of the coarser level.

    Args:
        pictures: [N, 3, H, W].
        kept: [N, 1, H, W], weight of each pixel in [0, 1]. Where it is 1, the image does not change.
    """
    height, width = pictures.shape[2:]
    if min(height, width) == 1:
        mean = (pictures * kept).sum((2, 3), keepdim=True) / kept.sum((2, 3), keepdim=True).clamp(min=LEAST)
        return kept * pictures + (1 - kept) * mean
    even = (0, width % 2, 0, height % 2)
    weight = avg_pool2d(pad(kept, even), 2)
    coarse = avg_pool2d(pad(pictures * kept, even), 2) / weight.clamp(min=LEAST)
    below = filled(coarse, (4 * weight).clamp(max=1))
    wide = interpolate(below, scale_factor=2.0, mode="bilinear")[:, :, :height, :width]
    return torch.lerp(wide, pictures, kept)
