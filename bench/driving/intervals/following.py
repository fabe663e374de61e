"""Following distances: how much of the gap to a braking leader the ego uses up until it is as slow as the leader."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from bench.driving.kinematics import Kinematics

FASTEST, STEP = 40.0, 0.5
"""Largest speed and resolution of a table, in m/s."""
LASTING_S = 8.0


@dataclass(frozen=True, kw_only=True)
class Braking:
    """How a car ahead is assumed to brake from now on: at `rate` m/s2 for `seconds`, then not at all, down to 0 m/s."""

    rate: float
    seconds: float


class FollowingDistance:
    """D(v, w): the largest part of a gap that the ego uses up, in m, by braking as hard as it can from the next decision on.

    Both cars are simulated once for every pair of speeds; values between are interpolated linearly. (A closed form with one
    deceleration, as in RSS, Shalev-Shwartz et al. 2017, does not fit: the ego brakes weakly near its lowest target speed.)

    Args:
        kinematics: kinematics of the ego.
        period: seconds per decision.
        leader: how the leader brakes.
        continuous: whether the ego brakes with its largest deceleration instead of repeated SLOWER.
        within: seconds that count; None for all until the speeds are the same.
    """

    def __init__(
        self, kinematics: Kinematics, period: float, leader: Braking, *, continuous: bool, within: float | None = None
    ) -> None:
        speeds = torch.arange(0.0, FASTEST + STEP, STEP, dtype=torch.float64)
        dt = period / kinematics.frames
        own, other = torch.meshgrid(speeds, speeds, indexing="ij")
        table, lost, target = torch.zeros_like(own), torch.zeros_like(own), own
        # The leader has braked for one decision when the ego begins to.
        other = (other - leader.rate * min(period, leader.seconds)).clamp(min=0)
        for frame in range(round((within or LASTING_S) / dt)):
            seconds = period + frame * dt
            if frame % kinematics.frames == 0:
                target = slower(own, kinematics.target_speeds)
            lost = lost + (own - other) * dt
            table = torch.maximum(table, lost)
            rate = kinematics.speed_gain * (target - own)
            if continuous:
                rate = torch.full_like(own, -kinematics.acceleration_limit)
            own = (own + rate * dt).clamp(min=0)
            other = (other - (leader.rate * dt if seconds < leader.seconds - 1e-9 else 0.0)).clamp(min=0)
        self.side = len(speeds)
        self.table = table.float().flatten()

    def __call__(self, own: Tensor, leader: Tensor) -> Tensor:
        """D [...] for the ego's speeds after its next decision and the leader's speeds now, differentiable in both."""
        first, second = (speed.clamp(0, FASTEST - 1e-3) / STEP for speed in torch.broadcast_tensors(own, leader))
        row, column = first.detach().floor(), second.detach().floor()
        down, right = first - row, second - column
        place = (row * self.side + column).long()
        table = self.table
        upper = table[place] * (1 - right) + table[place + 1] * right
        lower = table[place + self.side] * (1 - right) + table[place + self.side + 1] * right
        return upper * (1 - down) + lower * down


def slower(speed: Tensor, target_speeds: tuple[float, ...]) -> Tensor:
    """The target speed after SLOWER (highway-env's MDPVehicle.speed_to_index)."""
    low, high, last = target_speeds[0], target_speeds[-1], len(target_speeds) - 1
    index = ((speed - low) / (high - low) * last).round().clamp(0, last)
    return low + (index - 1).clamp(min=0) * ((high - low) / last)
