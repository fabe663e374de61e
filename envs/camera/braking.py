"""The brakes of the car: they build up, and the road limits them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cavbench.detection.stopping import GREATEST_DECELERATION
from cavbench.envs.camera.street.light import light, lighting
from cavbench.envs.weather import Weather

GRAVITY = 9.81
FRICTION = {"dry": 0.85, "wet": 0.6}
"""Peak coefficient of road adhesion of asphalt: the middles of 0.8 to 0.9 and 0.5 to 0.7 (Wong 2008, *Theory of Ground Vehicles*,
table 1.3)."""
BUILD_UP_S = 0.6
"""Time in which the deceleration grows from 0 to `GREATEST_DECELERATION`: the "jerking time" of UN Regulation 157's competent and
careful driver (Annex 3, guidance)."""
JERK = GREATEST_DECELERATION / BUILD_UP_S
"""Rate at which the deceleration grows or falls, in m/s3."""


@dataclass(frozen=True)
class Motion:
    """The motion of B cars, [B] each.

    Args:
        distance: distance to the line in m; negative beyond it.
        speed: speed in m/s.
        braking: deceleration in m/s2.
    """

    distance: Tensor
    speed: Tensor
    braking: Tensor

    def where(self, chosen: Tensor, other: Motion) -> Motion:
        """This motion for the chosen cars [B], the other one for the rest."""
        return Motion(*(torch.where(chosen, vars(self)[name], value) for name, value in vars(other).items()))


@dataclass(frozen=True)
class Brakes:
    """Brakes on a road.

    Args:
        greatest: largest deceleration in m/s2.
        jerk: rate at which the deceleration grows or falls, in m/s3; inf for brakes that act at once.
    """

    greatest: float = GREATEST_DECELERATION
    jerk: float = JERK

    def moved(self, motion: Motion, asked: Tensor, seconds: float) -> Motion:
        """The motion after a short time in which the driver asks for a deceleration [B] in m/s2.

        The deceleration changes linearly until it is the one asked for. Within this time its mean is used, so the speed is
        exact; the distance is exact except for the change of deceleration.
        """
        wanted = asked.clamp(0, self.greatest)
        change = wanted - motion.braking
        ramp_s = (change.abs() / self.jerk).clamp(max=seconds)
        braking = torch.where(ramp_s < seconds, wanted, motion.braking + change.sign() * self.jerk * ramp_s)
        mean = (motion.braking + braking) / 2 * ramp_s / seconds + braking * (1 - ramp_s / seconds)
        # A car that stops within this time does not move backwards.
        stops = mean * seconds >= motion.speed
        until = torch.where(stops, motion.speed / mean.clamp(min=1e-9), seconds)
        driven = motion.speed * until - mean * until.square() / 2
        return Motion(motion.distance - driven, torch.where(stops, 0.0, motion.speed - mean * until), braking)


def brakes_in(weather: Weather) -> Brakes:
    """The brakes of the car in a weather: the driver's limit on a dry road, friction on a wet one."""
    wet = light(lighting(weather), 0.0).wet
    return Brakes(greatest=min(GREATEST_DECELERATION, FRICTION["wet" if wet else "dry"] * GRAVITY))
