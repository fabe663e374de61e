"""The road of the racetrack: highway-env's envs/racetrack_env.py."""

from __future__ import annotations

from typing import Any

import numpy as np

from cavbench.envs.roads.network import Line, Network, circular, straight

WIDE, SPEED_LIMIT = 5.0, 10.0
START, FIRST_BEND = 0, 1
"""Columns of `ROAD.spots`: the left lanes of the first straight and of the first bend."""

N, C, S = Line.NONE, Line.CONTINUOUS, Line.STRIPED
OPTIONS: dict[str, Any] = {"width": WIDE, "speed_limit": SPEED_LIMIT}
STRAIGHTS: dict[str, Any] = {
    "ab": (([42, 0], [100, 0], (C, S)), ([42, 5], [100, 5], (S, C))),
    "cd": (([120, -20], [120, -30], (C, N)), ([125, -20], [125, -30], (S, C))),
    "fg": (([55.7, -15.7], [35.7, -35.7], (C, N)), ([59.3934, -19.2], [39.3934, -39.2], (S, C))),
}
"""Start, end and lines of the two lanes of each straight."""
ARCS: dict[str, Any] = {
    "bc": ([100, -20], False, ((20, 90, -1, (C, N)), (25, 90, -1, (S, C)))),
    "de": ([105, -30], False, ((15, 0, -181, (C, N)), (20, 0, -181, (S, C)))),
    "ef": ([70, -30], True, ((20, 0, 136, (C, S)), (15, 0, 137, (N, C)))),
    "gh": ([18.1, -18.1], False, ((25, 315, 170, (C, N)), (30, 315, 165, (S, C)))),
    "hi": ([18.1, -18.1], False, ((25, 170, 56, (C, N)), (30, 170, 58, (S, C)))),
    "ia": ([43.2, 23.4], True, ((23.5, 240, 270, (C, S)), (18.5, 238, 268, (N, C)))),
}
"""Centre, whether it turns to the right, and of each lane the radius in m, the angles in degrees and the lines."""


def racetrack(*, connected: bool) -> Network:
    """RacetrackEnv._make_road: a circuit of nine parts with two lanes."""
    net = Network(connected)
    for part in ("ab", "bc", "cd", "de", "ef", "fg", "gh", "hi", "ia"):
        if part in STRAIGHTS:
            for start, end, lines in STRAIGHTS[part]:
                net.add(part[0], part[1], straight(start, end, lines=lines, **OPTIONS))
            continue
        center, clockwise, lanes = ARCS[part]
        for radius, first, last, lines in lanes:
            angles = float(np.deg2rad(first)), float(np.deg2rad(last))
            net.add(part[0], part[1], circular(center, radius, *angles, clockwise=clockwise, lines=lines, **OPTIONS))
    return net


def spots(network: Network) -> list[int]:
    """The lanes of `START` and `FIRST_BEND`."""
    return [network.number("a", "b", 0), network.number("b", "c", 0)]
