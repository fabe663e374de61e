"""A benchmark weather as CARLA's weather parameters."""

from __future__ import annotations

from bench.scenarios.grid import Weather
from envs.camera.street.light import lighting

FULL_RAIN_MM_H = 50.0
"""Rain rate that CARLA's 100 stands for: from here on a shower is called violent (UK Met Office, fact sheet 3)."""
FULL_WET_MM_H = 5.0
"""Rain rate from which the whole road is wet."""
FULL_FOG_PER_M = 0.1
"""Extinction that CARLA's 100 stands for: a visibility of 30 m."""
CLEAR_CLOUDS, OVERCAST_CLOUDS = 5.0, 100.0
"""Cloudiness in percent: that of CARLA's clear presets, and a closed cover."""


def parameters(weather: Weather, sun_azimuth_deg: float) -> dict[str, float]:
    """The keyword arguments of `carla.WeatherParameters` for a weather.

    CARLA's percentages have no published unit. What they stand for here, each cut off at 100:

    - `precipitation` and `precipitation_deposits` (puddles): 100 R / 50, R the rain rate in mm/h;
    - `wetness` of the road: 100 R / 5;
    - `fog_density`: 100 sigma / 0.1, sigma the extinction in 1/m, the rain's own included (`Weather.extinction_per_m`);
    - `fog_distance` 0 m and `fog_falloff` 0: the fog begins at the camera and is as thick at every height (Koschmieder);
    - `cloudiness`: 100 where the embedded world has an overcast sky (rain, or a visibility below 1000 m), else 5;
    - `sun_altitude_angle`: the sun's elevation in degrees; `sun_azimuth_angle`: in degrees, [0, 360);
    - `scattering_intensity` 1 and `mie_scattering_scale` 0.03, as in every preset of the client.

    Args:
        weather: visibility, rain and sun.
        sun_azimuth_deg: as CARLA counts it; any number of turns.
    """
    rain = min(100.0, 100 * weather.precipitation_mm_h / FULL_RAIN_MM_H)
    return {
        "cloudiness": OVERCAST_CLOUDS if lighting(weather) == "overcast" else CLEAR_CLOUDS,
        "precipitation": rain,
        "precipitation_deposits": rain,
        "wetness": min(100.0, 100 * weather.precipitation_mm_h / FULL_WET_MM_H),
        "fog_density": min(100.0, 100 * weather.extinction_per_m / FULL_FOG_PER_M),
        "fog_distance": 0.0,
        "fog_falloff": 0.0,
        "sun_azimuth_angle": sun_azimuth_deg % 360.0,
        "sun_altitude_angle": weather.sun_elevation_deg,
        "scattering_intensity": 1.0,
        "mie_scattering_scale": 0.03,
    }
