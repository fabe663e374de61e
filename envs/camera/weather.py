"""The air between the camera and the street: extinction, fog and rain, in linear light.

All effects are affine in the arriving light, L -> T L + A, so for the texture of the sign they are only a gain.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cavbench.envs.weather import Weather

Image = NDArray[np.float32]

EXPOSURE_S = 1 / 250
"""Exposure time of a frame by day: the time in which a drop draws its streak."""
NEAREST_M, FARTHEST_M = 0.3, 5.0
"""Drops between these distances are drawn one by one; drops beyond are part of the extinction."""
SMALLEST_MM = 0.6
"""Smallest diameter of the drawn drops."""
SKY_M = 1500.0
"""Depth of the sky: nothing beyond it is visible through rain or fog."""


@dataclass(frozen=True)
class Air:
    """Effect of the air on a frame: L -> transmitted * L + added.

    Args:
        transmitted: share of the light, [H, W, 1].
        added: light, [H, W, 3].
    """

    transmitted: Image
    added: Image


def air(weather: Weather, depth: Image, street: Image, speed_mps: float, focal: float, seed: int) -> Air:
    """The air between the camera and a street in a weather.

    Args:
        weather: visibility and rain.
        depth: of each ray of a pixel in m, [rays, H, W], inf for the sky. A pixel at the edge of a pole gets the mean of the air
            before the pole and the sky.
        street: linear light without weather, [H, W, 3]; the airlight has the colour of its sky.
        speed_mps: speed of the car, which lengthens the streaks.
        focal: focal length in pixels.
        seed: seed of the drops.
    """
    airlight = _airlight(street, depth)
    # Koschmieder (1924): contrast falls exponentially, and scattered skylight replaces the lost light.
    each = np.exp(-np.float32(weather.extinction_per_m) * np.minimum(depth, SKY_M))
    transmitted = each.mean(0)[..., None].astype(np.float32)
    if weather.sun_elevation_deg < 0:
        airlight = airlight * 0.0
    added = airlight * (1 - transmitted)
    if weather.precipitation_mm_h > 0:
        rng = np.random.default_rng(seed)
        cover = streaks(weather.precipitation_mm_h, depth.min(0), speed_mps, focal, rng)[..., None]
        # A drop shows the world upside down, most of it sky (Garg and Nayar 2007, section 4: 0.94 of the sky's radiance).
        drop = 0.94 * airlight
        transmitted, added = transmitted * (1 - cover), added * (1 - cover) + drop * cover
    return Air(transmitted.astype(np.float32), added.astype(np.float32))


def _airlight(street: Image, depth: Image) -> NDArray[np.float32]:
    """Mean colour [3] of the visible sky, or of the brightest twentieth of the street."""
    sky = np.isinf(depth).all(0)
    if sky.mean() > 0.01:
        return street[sky].mean(0)
    luminance = street.mean(-1)
    return street[luminance >= np.quantile(luminance, 0.95)].mean(0)


def streaks(rate_mm_h: float, depth: Image, speed_mps: float, focal: float, rng: np.random.Generator) -> Image:
    """Share of the exposure during which drops hide the background, [H, W].

    Drop sizes by Marshall and Palmer (1948), N(D) = 8000 exp(-4.1 R^-0.21 D) drops a m3 and mm; terminal speeds by Atlas et al.
    (1973), v = 9.65 - 10.3 exp(-0.6 D) m/s with D in mm; each drop is projected at both ends of the exposure.
    """
    height, width = depth.shape
    slope = 4.1 * rate_mm_h**-0.21
    across, up = width / 2 / focal, height / 2 / focal
    volume = 4 * across * up / 3 * (FARTHEST_M**3 - NEAREST_M**3) * 1.2
    count = rng.poisson(8000 / slope * np.exp(-slope * SMALLEST_MM) * volume)
    z = np.cbrt(rng.uniform(NEAREST_M**3, FARTHEST_M**3, count))
    diameter = np.minimum(SMALLEST_MM + rng.exponential(1 / slope, count), 6.0)
    fall = 9.65 - 10.3 * np.exp(-0.6 * diameter)
    x, y = rng.uniform(-across, across, count) * z, rng.uniform(-1.2 * up, 1.2 * up, count) * z
    wind = rng.normal(0.6, 0.4, count)
    later = np.maximum(z - speed_mps * EXPOSURE_S, 0.1)
    start = np.stack([x / z, y / z], 1) * focal + np.array([width, height]) / 2
    end = np.stack([(x + wind * EXPOSURE_S) / later, (y + fall * EXPOSURE_S) / later], 1) * focal
    end += np.array([width, height]) / 2
    wide = np.maximum(diameter / 1000 / z * focal, 1e-3)
    length = np.linalg.norm(end - start, axis=1) + wide
    # A drop thinner than a pixel hides a share of it, and is at each point of its streak for a share of the exposure.
    share = np.minimum(wide, 1.0) * wide / length
    clear = np.ones((height, width), np.float32)
    for layer in np.array_split(np.argsort(-z), 12):
        drawn = np.zeros((height, width), np.float32)
        for number in layer:
            a, b = (start[number] * 16).astype(int), (end[number] * 16).astype(int)
            thick = max(1, round(wide[number]))
            cv2.line(drawn, a.tolist(), b.tolist(), float(share[number]), thick, cv2.LINE_AA, 4)
        near = z[layer].mean()
        # Near drops are out of focus.
        soft = cv2.GaussianBlur(drawn, (0, 0), 0.5 + 1.2 / near)
        clear *= np.where(depth > near, 1 - np.clip(soft, 0, 0.95), 1)
    return 1 - clear
