"""Following distances: how much of the gap to a braking leader the ego uses up until it is as slow as the leader."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from bench.driving.intervals.kernels import FASTEST, HARDEST, LEVELS_PER_UNIT, STEP
from bench.driving.kinematics import Kinematics

LASTING_S = 8.0


class FollowingDistance:
    """D(v, w, r): the largest part of a gap that the ego uses up, in m, by braking as hard as it can from the next decision on.

    The leader brakes at r m/s2 for `seconds`, then keeps its speed. Both cars are simulated once for a grid of speeds and
    rates; values between are interpolated linearly. (A closed form with one deceleration, as in RSS, Shalev-Shwartz et al.
    2017, does not fit: the ego brakes weakly near its lowest target speed.)

    Args:
        kinematics: kinematics of the ego.
        period: seconds per decision.
        seconds: how long the leader brakes.
        within: seconds that count, for each of the results; None for all until the speeds are the same.
        braking: the ego's own deceleration in m/s2, for continuous actions; None for repeated SLOWER.
    """

    def __init__(
        self,
        kinematics: Kinematics,
        period: float,
        seconds: float,
        *,
        within: tuple[float | None, ...] = (None,),
        braking: float | None = None,
    ) -> None:
        speeds = torch.arange(0.0, FASTEST + STEP, STEP, dtype=torch.float64)
        rates = torch.arange(HARDEST * LEVELS_PER_UNIT + 1.0, dtype=torch.float64) / LEVELS_PER_UNIT
        dt = period / kinematics.frames
        rate, own, other = torch.meshgrid(rates, speeds, speeds, indexing="ij")
        table, lost, target = torch.zeros_like(own), torch.zeros_like(own), own
        # The leader has braked for one decision when the ego begins to.
        other = (other - rate * min(period, seconds)).clamp(min=0)
        ends = [round((counted or LASTING_S) / dt) for counted in within]
        tables = {}
        for frame in range(max(ends)):
            if frame % kinematics.frames == 0:
                target = slower(own, kinematics.target_speeds)
            lost = lost + (own - other) * dt
            table = torch.maximum(table, lost)
            change = kinematics.speed_gain * (target - own) if braking is None else torch.full_like(own, -braking)
            own = (own + change * dt).clamp(min=0)
            if period + frame * dt < seconds - 1e-9:
                other = (other - rate * dt).clamp(min=0)
            if frame + 1 in ends:
                tables[frame + 1] = table.float().flatten().numpy()
        self.side = len(speeds)
        self.tables = np.stack([tables[end] for end in ends])


def slower(speed: Tensor, target_speeds: tuple[float, ...]) -> Tensor:
    """The target speed after SLOWER (highway-env's MDPVehicle.speed_to_index)."""
    low, high, last = target_speeds[0], target_speeds[-1], len(target_speeds) - 1
    index = ((speed - low) / (high - low) * last).round().clamp(0, last)
    return low + (index - 1).clamp(min=0) * ((high - low) / last)
