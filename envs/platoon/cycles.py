"""Drive cycles of a platoon's leader (compiled)."""

from __future__ import annotations

import math

import numpy as np

from cavbench.compiled import entry_point, inner
from cavbench.envs.platoon.draws import uniform
from cavbench.envs.platoon.motion import PERIOD, clipped, moved

MOTORWAY, STOP_AND_GO, BRAKING, WAVE = range(4)
CYCLE, STARTS = 1, 2
"""What random numbers are for."""
GAIN = 1.0
"""1/s: how fast the leader takes a new speed."""


@inner
def start_speed(seed: int, cycle: int) -> float:
    """Speed of the platoon at the start, in m/s."""
    share = uniform(seed, CYCLE, 0, 0)
    return 8 + 4 * share if cycle == STOP_AND_GO else 22 + 8 * share


@inner
def part(seed: int, cycle: int, number: int, cruise: float) -> tuple[float, float, float]:
    """Seconds, speed in m/s and largest acceleration in m/s2 of a part of a cycle."""
    one, two = uniform(seed, CYCLE, number + 1, 1), uniform(seed, CYCLE, number + 1, 2)
    if cycle == MOTORWAY:
        return 5 + 5 * one, cruise + 10 * (two - 0.5), 1.5
    if cycle == STOP_AND_GO:
        return 6 + 6 * one, (3 * two if number % 2 else 8 + 6 * two), 2.0
    if number % 2:
        return 1 + one, 0.0, 3 + 2.5 * two
    return 8 + 6 * one, cruise, 2.0


@entry_point
def plan(seeds: np.ndarray, cycles: np.ndarray, commands: np.ndarray, speeds: np.ndarray) -> None:
    """The leader's commands and the speed at the start.

    Args:
        seeds, cycles: int64 [R].
        commands: float64 [R, T] m/s2, written.
        speeds: float64 [R] m/s, written.
    """
    for row in range(len(seeds)):
        seed, cycle = seeds[row], cycles[row]
        cruise = speeds[row] = start_speed(seed, cycle)
        if cycle == WAVE:
            # Frequencies at which people drive, evenly on a logarithmic scale.
            omega = 0.1 * 10 ** uniform(seed, CYCLE, 1, 1)
            height = min(0.5 + uniform(seed, CYCLE, 1, 2), 10 * omega)
            for step in range(commands.shape[1]):
                commands[row, step] = height * math.cos(omega * step * PERIOD)
            continue
        x, v, a, number = 0.0, cruise, 0.0, 0
        left, target, most = part(seed, cycle, 0, cruise)
        for step in range(commands.shape[1]):
            if left <= 0:
                number += 1
                left, target, most = part(seed, cycle, number, cruise)
            u = clipped(min(max(GAIN * (target - v), -most), most))
            commands[row, step] = u
            x, v, a = moved(x, v, a, u)
            left -= PERIOD
