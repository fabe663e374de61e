"""A benchmark weather as CARLA's parameters: known values, ranges, and what more rain or less visibility does."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.scenarios.grid import WEATHERS, Weather
from envs.camera.carla.weather import parameters

RAIN = st.floats(0, 300)
VISIBILITY = st.floats(1, 1e6)
PERCENT = ("cloudiness", "precipitation", "precipitation_deposits", "wetness", "fog_density")


def test_clear_air_has_no_rain_and_no_fog() -> None:
    given_ = parameters(WEATHERS["clear"], 195.0)
    assert [given_[name] for name in PERCENT] == [5.0, 0.0, 0.0, 0.0, 0.0]
    assert given_["sun_altitude_angle"] == 45.0
    assert given_["sun_azimuth_angle"] == 195.0


def test_rain_of_25_mm_h_is_half_of_violent_on_a_wet_road_under_clouds() -> None:
    given_ = parameters(WEATHERS["rain"], 0.0)
    assert [given_[name] for name in PERCENT[:4]] == [100.0, 50.0, 50.0, 100.0]
    assert given_["fog_density"] == pytest.approx(3.64, abs=0.01)


def test_a_visibility_of_120_m_is_a_quarter_of_the_thickest_fog() -> None:
    given_ = parameters(WEATHERS["fog"], 0.0)
    assert [given_[name] for name in PERCENT[:4]] == [100.0, 0.0, 0.0, 0.0]
    assert given_["fog_density"] == pytest.approx(25.0)
    assert (given_["fog_distance"], given_["fog_falloff"]) == (0.0, 0.0)


@given(visibility=VISIBILITY, rain=RAIN, azimuth=st.floats(-2000, 2000), elevation=st.floats(-90, 90))
def test_every_value_is_in_the_range_that_the_client_documents(
    visibility: float, rain: float, azimuth: float, elevation: float
) -> None:
    weather = Weather(name="any", visibility_m=visibility, precipitation_mm_h=rain, sun_elevation_deg=elevation)
    given_ = parameters(weather, azimuth)
    assert all(0 <= given_[name] <= 100 for name in PERCENT)
    assert 0 <= given_["sun_azimuth_angle"] <= 360
    assert given_["sun_altitude_angle"] == elevation


@given(near=VISIBILITY, far=VISIBILITY, rain=RAIN)
def test_a_shorter_visibility_never_thins_the_fog_nor_opens_the_sky(near: float, far: float, rain: float) -> None:
    near, far = sorted((near, far))
    thick, thin = (parameters(Weather(name="any", visibility_m=v, precipitation_mm_h=rain), 0.0) for v in (near, far))
    assert thick["fog_density"] >= thin["fog_density"]
    assert thick["cloudiness"] >= thin["cloudiness"]


@given(less=RAIN, more=RAIN, visibility=VISIBILITY)
def test_more_rain_never_lowers_anything(less: float, more: float, visibility: float) -> None:
    less, more = sorted((less, more))
    dry, wet = (
        parameters(Weather(name="any", visibility_m=visibility, precipitation_mm_h=r), 0.0) for r in (less, more)
    )
    assert all(wet[name] >= dry[name] for name in PERCENT)
