"""From light to an image: exposure and the camera's tone curve."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

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


def srgb(linear: Tensor) -> Tensor:
    """IEC 61966-2-1, from linear to coded values in [0, 1]."""
    return torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp(min=0.0031308) ** (1 / 2.4) - 0.055)


def linear(coded: Tensor) -> Tensor:
    """IEC 61966-2-1, from coded to linear values in [0, 1]."""
    return torch.where(coded <= 0.04045, coded / 12.92, ((coded.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4)
