"""From light to an image: exposure and the camera's tone curve."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavbench.detection.colour import linear, srgb

LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Luminance weights of linear sRGB (ITU-R BT.709)."""
MIDDLE_GREY = 0.18
HIGHLIGHTS = 0.9
NOISE = {"sun": 0.005, "overcast": 0.008, "night": 0.02}
"""Standard deviation of the sensor noise on the sRGB scale: in less light the gain is higher."""


def exposure(light: NDArray[np.float32]) -> float:
    """Factor by which automatic exposure multiplies the light [H, W, 3] of a frame.

    The logarithmic mean becomes middle grey, or less if otherwise more than 4 % of the image would be overexposed.
    """
    luminance = light @ np.array(LUMINANCE, np.float32)
    dim = np.minimum(luminance, np.quantile(luminance, 0.97))
    mean = float(np.exp(np.log(np.maximum(dim, 1e-5)).mean()))
    return min(MIDDLE_GREY / mean, HIGHLIGHTS / float(np.quantile(luminance, 0.96)))


def tone(light: Tensor) -> Tensor:
    """sRGB in [0, 1] of exposed light: a film-like curve (Narkowicz 2015, "ACES filmic tone mapping curve"), then sRGB coding."""
    x = 0.8 * light.clamp(min=0)
    curved = (x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14)).clamp(0, 1)
    return srgb(curved)


def light_of(picture: Tensor) -> Tensor:
    """Exposed light of an sRGB picture in [0, 1], the inverse of `tone`; white is the least light that is shown white."""
    y = linear(picture)
    # The positive root of 2.51 x^2 + 0.03 x = y (2.43 x^2 + 0.59 x + 0.14).
    a, b, c = 2.51 - 2.43 * y, 0.03 - 0.59 * y, -0.14 * y
    return (torch.sqrt(b * b - 4 * a * c) - b) / (2 * a) / 0.8
