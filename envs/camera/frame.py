"""One frame of the bank: a developed image, and the light on the sign's crop, which depends on the texture.

On the crop, the light is L = black + gain * texture, with exposure and weather applied (`cavbench.envs.camera.weather`).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from cavbench.detection.stopping import SPEED_MPS
from cavbench.envs.camera import develop, sign
from cavbench.envs.camera.poses import Pose
from cavbench.envs.camera.street.layout import LOCATIONS, sign_x
from cavbench.envs.camera.street.light import lighting
from cavbench.envs.camera.street.render import Traced
from cavbench.envs.camera.weather import air
from cavbench.envs.weather import Weather

QUALITY, LOWER_QUALITY = 85, 60
"""WebP quality of the image, lower on the closed loop and at the places with one road; the sign's crop is stored separately."""
GAMMA = 2.2
"""The light of the crop is stored in 8 bits as (value / largest) ** (1 / GAMMA)."""


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame as it is stored.

    Args:
        picture: WebP of the developed frame with a black sign, without sensor noise.
        crop: x0, y0, x1, y1 around the sign in pixels, inside the image; empty if the sign is outside.
        black, gain: uint8 [h, w, 3], coded with `GAMMA`.
        scale: light of code 255 in black and in gain.
        printed: share of the gain that a print on the sign has, for each colour; 1 by day, little in headlights.
        visible: share of the sign that is inside the image and not hidden, in [0, 1].
    """

    picture: NDArray[np.uint8]
    crop: tuple[int, int, int, int]
    black: NDArray[np.uint8]
    gain: NDArray[np.uint8]
    scale: tuple[float, float]
    printed: sign.Colour
    visible: float


def frame(traced: Traced, pose: Pose, weather: Weather) -> Frame:
    """Develop a traced pose in a weather."""
    x0, y0, x1, y1 = traced.crop
    between = air(weather, traced.depth, traced.black, SPEED_MPS, pose.camera.focal, pose.seed)
    light = traced.black * between.transmitted + between.added
    factor = develop.exposure(light)
    picture = develop.tone(torch.from_numpy(light * factor)).numpy()
    place = LOCATIONS[pose.location]
    quality = LOWER_QUALITY if place.closed_loop or place.one_road else QUALITY
    done, webp = cv2.imencode(
        ".webp", np.rint(255 * picture[..., ::-1]).astype(np.uint8), [cv2.IMWRITE_WEBP_QUALITY, quality]
    )
    assert done
    black, most_black = _coded(light[y0:y1, x0:x1] * factor)
    gain, most_gain = _coded(traced.gain * between.transmitted[y0:y1, x0:x1] * factor)
    whole = cv2.contourArea(pose.camera.project(sign.corners(sign_x(pose.lanes))).astype(np.float32))
    visible = min(1.0, float(traced.coverage.sum()) / whole)
    red, green, blue = traced.printed.tolist()
    return Frame(webp.ravel(), traced.crop, black, gain, (most_black, most_gain), (red, green, blue), visible)


def _coded(light: NDArray[np.float32]) -> tuple[NDArray[np.uint8], float]:
    most = float(light.max(initial=1e-6))
    return np.rint(255 * (light.clip(0) / most) ** (1 / GAMMA)).astype(np.uint8), most


def noise_level(weather: Weather) -> float:
    """Standard deviation of the sensor noise on the sRGB scale."""
    return develop.NOISE[lighting(weather)]
