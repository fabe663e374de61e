"""The sensor model of the weather: range and noise of the ego's measurements. Both environments use these functions.

Range: the return of an active sensor from distance R is proportional to exp(-2 beta R) / R^2 (monostatic equation). The range
is the distance R whose return equals the return from 200 m (highway-env's limit) in clear air: R exp(beta R) = 200 m.
Noise: zero-mean Gaussian on x, y (m) and vx, vy (m/s) of the other vehicles. Its size is our modelling choice.
The noise is a hash of (scenario seed, step, vehicle, feature), so it does not depend on the order of draws or on the batch.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavbench.compiled import entry_point, inner
from cavbench.envs.weather import Weather

CLEAR_RANGE_M = 200.0
"""AbstractEnv.PERCEPTION_DISTANCE: 5 times the maximum speed."""
SIGMA_PER_MM_H = 0.008
SIGMA_PER_EXTINCTION = 4.0

FEATURES = 4
TWO_PI = 2 * np.pi
UNIT_PER_BIT = 1.0 / 2**53


def sensor_range_m(weather: Weather) -> float:
    """Range of the sensor in m: the root R of R exp(beta R) = 200, by Newton's method on its logarithm."""
    extinction = weather.extinction_per_m
    if extinction == 0:
        return CLEAR_RANGE_M
    distance = CLEAR_RANGE_M / (1 + extinction * CLEAR_RANGE_M)
    for _ in range(50):
        excess = math.log(distance / CLEAR_RANGE_M) + extinction * distance
        distance -= excess / (1 / distance + extinction)
    return distance


def noise_sigma(weather: Weather) -> float:
    """Standard deviation of the measurements, in m (positions) and m/s (velocities)."""
    return SIGMA_PER_MM_H * weather.precipitation_mm_h + SIGMA_PER_EXTINCTION * weather.extinction_per_m


@inner
def mix(value: np.uint64) -> np.uint64:
    """Finaliser of splitmix64 (Steele, Lea and Flood 2014): a bijection on 64 bits that decorrelates counters."""
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


@inner
def counter_hash(seed: int, step: int, vehicle: int, draw: int) -> np.uint64:
    """64 uniform bits for one counter; each part is mixed in separately, so that neighbouring counters are unrelated."""
    step_size = np.uint64(0x9E3779B97F4A7C15)
    value = mix(np.uint64(seed) + step_size)
    value = mix((value ^ np.uint64(step)) + step_size)
    value = mix((value ^ np.uint64(vehicle)) + step_size)
    return mix((value ^ np.uint64(draw)) + step_size)


@inner
def standard_normal(seed: int, step: int, vehicle: int, feature: int) -> float:
    """One standard normal number: the Box-Muller transform of two hashed uniforms."""
    radius_bits = counter_hash(seed, step, vehicle, 2 * feature) >> np.uint64(11)
    angle_bits = counter_hash(seed, step, vehicle, 2 * feature + 1) >> np.uint64(11)
    # (bits + 1) keeps the logarithm finite.
    radius = math.sqrt(-2.0 * math.log((np.float64(radius_bits) + 1.0) * UNIT_PER_BIT))
    return radius * math.cos(TWO_PI * np.float64(angle_bits) * UNIT_PER_BIT)


@entry_point
def add_noise(measured: NDArray[np.float64], sigma: float, seed: int, step: int, vehicle: int) -> None:
    """Add noise to one vehicle's measured x, y, vx, vy [4], in place, in physical units; sigma 0 changes no bit."""
    if sigma > 0.0:
        for feature in range(FEATURES):
            measured[feature] += sigma * standard_normal(seed, step, vehicle, feature)
