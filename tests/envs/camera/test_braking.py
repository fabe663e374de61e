"""The brakes of the car: they stop where mechanics says, and a wet road limits them."""

from __future__ import annotations

import pytest
import torch

from cavbench.detection import stopping
from cavbench.envs.camera.braking import JERK, Brakes, Motion, brakes_in
from cavbench.envs.weather import WEATHERS


def test_the_brakes_stop_where_mechanics_says() -> None:
    """v^2 / 2a, and what the growth of the deceleration in the time T = a / jerk adds: v T / 2 - a T^2 / 24."""
    speed, asked = (
        part.ravel() for part in torch.meshgrid(torch.linspace(5, 20, 16), torch.linspace(1, 7.5, 14), indexing="ij")
    )
    motion, brakes = Motion(torch.zeros(len(speed)), speed, torch.zeros(len(speed))), Brakes()
    while motion.speed.any():
        motion = brakes.moved(motion, asked, 0.01)
    ramp = asked / JERK
    wanted = speed.square() / (2 * asked) + speed * ramp / 2 - asked * ramp.square() / 24
    torch.testing.assert_close(-motion.distance, wanted, atol=0.01, rtol=0)


def test_a_wet_road_limits_the_brakes() -> None:
    greatest = {name: brakes_in(weather).greatest for name, weather in WEATHERS.items()}
    assert greatest["clear"] == greatest["night"] == stopping.GREATEST_DECELERATION
    assert greatest["rain"] == greatest["fog"] == pytest.approx(0.6 * 9.81)
