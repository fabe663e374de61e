"""The light of a weather: sun and sky, an overcast sky, or headlights and street lamps at night."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cavbench.envs.camera.street.textures import noise
from cavbench.envs.weather import Weather

HEADLIGHTS_X = (-0.62, 0.62)
HEADLIGHT_HEIGHT_M = 0.68
HEADLIGHT_AHEAD_M = 1.6
"""How far the headlights are ahead of the camera."""
BEAM_FIELD_DEG = 90.0
"""Horizontal field of the low beam's pattern."""
BEAM_PEAK_CD = 20_000.0
"""Brightest direction of a low beam (a usual figure for halogen and LED alike)."""
LAMP_CD = 1_000.0
"""Intensity of a street lamp, downwards."""


Lighting = Literal["sun", "overcast", "night"]
"""The light that a pose is traced in; several weathers share one."""


@dataclass(frozen=True)
class Light:
    """The light of a scene.

    Args:
        sun: unit vector [3] towards the sun, which has its own sky; or None.
        sky: radiance of the sky without a sun, [H, W, 3], by elevation (first row: zenith) and azimuth.
        headlights: whether the ego's low beams and the street lamps are on.
        wet: whether the road is wet.
    """

    sun: NDArray[np.float64] | None = None
    sky: NDArray[np.float32] | None = None
    headlights: bool = False
    wet: bool = False


def lighting(weather: Weather) -> Lighting:
    """The lighting of a weather: night if the sun is below the horizon, overcast in rain and in fog, else sun."""
    if weather.sun_elevation_deg < 0:
        return "night"
    dull = weather.precipitation_mm_h > 0 or weather.visibility_m < 1000
    return "overcast" if dull else "sun"


def light(kind: Lighting, sun_azimuth_deg: float, sun_elevation_deg: float = 45.0) -> Light:
    """The light of a place; under an overcast sky the road is wet."""
    if kind == "night":
        return Light(sky=0.012 * overcast((0.55, 0.72, 1.0)), headlights=True)
    if kind == "overcast":
        return Light(sky=overcast((0.93, 0.97, 1.0)), wet=True)
    azimuth, elevation = np.deg2rad([sun_azimuth_deg, sun_elevation_deg])
    towards = [np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)]
    return Light(sun=np.array(towards))


def overcast(tint: tuple[float, float, float], height: int = 128) -> NDArray[np.float32]:
    """Radiance [height, 2 * height, 3] of the CIE standard overcast sky, (1 + 2 sin elevation) / 3, with some clouds."""
    up = np.cos((np.arange(height) + 0.5) / height * np.pi)
    level = np.where(up > 0, (1 + 2 * up) / 3, 0.12)
    clouds = 0.75 + 0.5 * noise(2 * height, np.random.default_rng(3), 5, 3)[:height]
    return (level[:, None, None] * clouds[..., None] * np.array(tint)).astype(np.float32)


def low_beam(width: int = 512, height: int = 160) -> NDArray[np.float32]:
    """Pattern [height, width] of a low beam on a plane in front of it, 1 at its peak; first row up, `BEAM_FIELD_DEG` wide.

    It has a hot spot just below the horizon, a cut-off that rises by 15 degrees to the right (UN Regulation 112), a wide and weak
    foreground, so that the road near the car is not brighter than the road ahead, and some stray light above the cut-off, which
    makes overhead signs visible.
    """
    half = np.tan(np.deg2rad(BEAM_FIELD_DEG / 2))
    x = ((np.arange(width) + 0.5) / width * 2 - 1) * half
    y = (1 - (np.arange(height) + 0.5) / height * 2) * half * height / width
    across, up = np.meshgrid(np.rad2deg(np.arctan(x)), np.rad2deg(np.arctan(y)))
    cutoff = np.clip(np.tan(np.deg2rad(15)) * across, 0, 1.2) - 0.6
    below = 1 / (1 + np.exp((up - cutoff) / 0.25))
    spot = np.exp(-(((across - 1) / 9) ** 2) - ((up + 1.4) / 1.3) ** 2)
    wide = 0.16 * np.exp(-((across / 26) ** 2)) * np.exp((up + 1) / 2.6)
    stray = 0.012 * np.exp(-((across / 30) ** 2) - (np.maximum(up, 0) / 8) ** 2)
    return (below * (spot + wide) + stray).astype(np.float32)
