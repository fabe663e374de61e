"""The sensor model of the weather: range and noise."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from cavbench.envs.highway.axes import AXES
from cavbench.envs.highway.config import HighwayConfig
from cavbench.envs.highway.engine import HighwayEngine
from cavbench.envs.highway.sensor import add_noise, noise_sigma, sensor_range_m
from cavbench.envs.weather import WEATHERS, Weather

visibilities = st.floats(10, 1e6)
rains = st.floats(0, 150)


@given(visibilities, rains)
def test_range_solves_the_sensor_equation(visibility: float, rain: float) -> None:
    weather = Weather(name="any", visibility_m=visibility, precipitation_mm_h=rain)
    reach = sensor_range_m(weather)
    assert reach * math.exp(weather.extinction_per_m * reach) == pytest.approx(200.0, rel=1e-9)


@given(visibilities, visibilities, rains)
def test_stronger_extinction_never_improves_the_sensor(one: float, other: float, rain: float) -> None:
    thick, thin = (Weather(name="any", visibility_m=v, precipitation_mm_h=rain) for v in sorted((one, other)))
    assert sensor_range_m(thick) <= sensor_range_m(thin) <= 200
    assert noise_sigma(thick) >= noise_sigma(thin)


def test_in_clear_air_the_observation_equals_highway_envs() -> None:
    assert sensor_range_m(WEATHERS["clear"]) == 200.0
    assert noise_sigma(WEATHERS["clear"]) == 0.0
    measured = np.array([0.1, -0.2, 1e-17, 3.0])
    before = measured.copy()
    add_noise(measured, 0.0, 1, 2, 3)
    assert (measured == before).all()


def test_weather_changes_observations_but_not_the_traffic() -> None:
    cells = tuple(AXES.cell(lanes=3, density=2.0, weather=name) for name in ("clear", "rain", "fog"))
    engine = HighwayEngine(HighwayConfig(cells=cells))
    engine.reset(np.arange(3), np.full(3, 8))
    for _ in range(10):
        engine.step(np.full(3, 4))
    assert all((engine.vehicles[row] == engine.vehicles[0]).all() for row in (1, 2))
    clear, rain, fog = engine.observation
    assert (clear[0] == rain[0]).all()
    assert (clear[0] == fog[0]).all()
    # The same cars in the same rows, fewer of them, not quite where they are.
    assert fog[:, 0].sum() < clear[:, 0].sum()
    both = rain[:, 0] > 0
    error = np.abs(rain - clear)[both][1:]
    assert 0 < error.max() < 0.1


def noise(seed: int, step: int, vehicle: int) -> list[float]:
    """The noise of the four features of a vehicle, sigma 1."""
    measured = np.zeros(4)
    add_noise(measured, 1.0, seed, step, vehicle)
    return measured.tolist()


def test_noise_is_standard_normal_and_uncorrelated() -> None:
    draws = np.array([noise(*counter) for counter in itertools.product(range(20), range(20), range(20))])
    assert stats.kstest(draws.ravel(), "norm").pvalue > 1e-3
    assert np.abs(np.corrcoef(draws.T) - np.eye(4)).max() < 0.05
    by_counter = draws.reshape(20, 20, 20, 4)
    for axis in range(3):
        ahead, behind = np.delete(by_counter, 0, axis), np.delete(by_counter, -1, axis)
        assert abs(np.corrcoef(ahead.ravel(), behind.ravel())[0, 1]) < 0.03


def test_noise_depends_on_scenario_step_and_vehicle_only() -> None:
    assert noise(5, 6, 7) == noise(5, 6, 7)
    others = [noise(*counter) for counter in ((5, 6, 7), (6, 6, 7), (5, 7, 7), (5, 6, 8))]
    assert len({value for drawn in others for value in drawn}) == 16


def test_noise_has_the_stated_size_in_metres() -> None:
    cells = tuple(AXES.cell(lanes=3, density=2.0, weather=name) for name in ("clear", "rain"))
    engine = HighwayEngine(HighwayConfig(cells=cells * 40))
    seeds = np.repeat(np.arange(40), 2)
    engine.reset(np.arange(80), seeds)
    seen = torch.from_numpy(engine.observation.reshape(40, 2, 10, 5))
    present = (seen[:, 1, 1:, 0] > 0) & (seen[:, :, 1:, 1].abs() < 0.99).all(1)
    error = ((seen[:, 1] - seen[:, 0])[:, 1:, 1:] * torch.tensor([100.0, 20.0, 40.0, 20.0]))[present]
    assert error.std().item() == pytest.approx(noise_sigma(WEATHERS["rain"]), rel=0.15)
    assert abs(error.mean().item()) < 0.05
