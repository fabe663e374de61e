"""Following distances: how much of the gap to a braking leader the ego uses up until it is as slow as the leader."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavbench.driving.intervals.kernels import FASTEST, HARDEST, LEVELS_PER_UNIT, STEP
from cavbench.driving.kinematics import Kinematics

LASTING_S = 8.0
"""Seconds after which two cars have the same speed."""


class Case(NamedTuple):
    """A case in which a following distance is wanted.

    Args:
        within: seconds that count.
        held: seconds for which the ego keeps its speed before it brakes.
    """

    within: float = LASTING_S
    held: float = 0.0


class FollowingDistance:
    """D(v, w, r): the largest part of a gap that the ego uses up, in m, by braking as hard as it can from the next decision on.

    The leader brakes at r m/s2 for `seconds`, then keeps its speed. Both cars are simulated once for a grid of speeds and
    rates; values between are interpolated linearly. (A closed form with one deceleration, as in RSS, Shalev-Shwartz et al.
    2017, does not fit: the ego brakes weakly near its lowest target speed.)

    Args:
        kinematics: kinematics of the ego.
        period: seconds per decision.
        seconds: how long the leader brakes.
        cases: what each of the results is for.
        braking: the ego's own deceleration in m/s2, for continuous actions; None for repeated SLOWER.
    """

    def __init__(
        self,
        kinematics: Kinematics,
        period: float,
        seconds: float,
        *,
        cases: tuple[Case, ...] = (Case(),),
        braking: float | None = None,
    ) -> None:
        self.side = round(FASTEST / STEP) + 1
        # A car that comes nearer does not stop for the ego, so it takes its speed times the seconds until then.
        self.meeting = np.array([(period + case.within) * kinematics.oncoming for case in cases], np.float32)
        self.tables = np.stack([_table(kinematics, period, seconds, case, braking) for case in cases])


@cache
def _table(
    kinematics: Kinematics, period: float, seconds: float, case: Case, braking: float | None
) -> NDArray[np.float32]:
    """The following distances of a case, [rates * speeds * speeds]; arguments as of `FollowingDistance`."""
    speeds = torch.arange(0.0, FASTEST + STEP, STEP, dtype=torch.float64)
    rates = torch.arange(HARDEST * LEVELS_PER_UNIT + 1.0, dtype=torch.float64) / LEVELS_PER_UNIT
    dt = period / kinematics.frames
    rate, own, other = torch.meshgrid(rates, speeds, speeds, indexing="ij")
    most, lost, target = torch.zeros_like(own), torch.zeros_like(own), own
    # The leader has braked for one decision when the ego begins to.
    other = (other - rate * min(period, seconds)).clamp(min=0)
    for frame in range(round(case.within / dt)):
        holds = frame * dt < case.held - 1e-9
        if not holds and frame % kinematics.frames == 0:
            target = slower(own, kinematics.target_speeds)
        lost = lost + (own - other) * dt
        most = torch.maximum(most, lost)
        braked = kinematics.speed_gain * (target - own) if braking is None else torch.full_like(own, -braking)
        own = own if holds else (own + braked * dt).clamp(min=0)
        if period + frame * dt < seconds - 1e-9:
            other = (other - rate * dt).clamp(min=0)
    return most.float().flatten().numpy()


def slower(speed: Tensor, target_speeds: tuple[float, ...]) -> Tensor:
    """The target speed after SLOWER (highway-env's MDPVehicle.speed_to_index)."""
    low, high, last = target_speeds[0], target_speeds[-1], len(target_speeds) - 1
    index = ((speed - low) / (high - low) * last).round().clamp(0, last)
    return low + (index - 1).clamp(min=0) * ((high - low) / last)
