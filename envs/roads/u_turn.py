"""The road of the U-turn: highway-env's envs/u_turn_env.py."""

from __future__ import annotations

import numpy as np

from cavbench.envs.roads.network import WIDTH, Line, Network, Way, circular, straight

LENGTH, RADIUS = 128.0, 20.0
DESTINATIONS = ("d",)
WAY = Way(roads=(("a", "b"), ("b", "c"), ("c", "d")), goal=100.0)
"""The way of the ego, to 100 m behind the half circle."""

N, C, S, L = Line.NONE, Line.CONTINUOUS, Line.STRIPED, Line.CONTINUOUS_LINE


def u_turn(*, connected: bool) -> Network:
    """UTurnEnv._make_road: two lanes there, round a half circle and back."""
    net = Network(connected)
    net.add("c", "d", straight([LENGTH, WIDTH], [0, WIDTH], lines=(L, S)))
    net.add("c", "d", straight([LENGTH, 0], [0, 0], lines=(N, L)))
    for lane, lines in enumerate(((C, S), (N, C))):
        first, last = float(np.deg2rad(90)), float(np.deg2rad(-90))
        center, radius = [LENGTH, WIDTH + 20], RADIUS + WIDTH * lane
        net.add("b", "c", circular(center, radius, first, last, clockwise=False, lines=lines))
    offset = 2 * RADIUS
    net.add("a", "b", straight([0, WIDTH + offset], [LENGTH, WIDTH + offset], lines=(L, S)))
    net.add("a", "b", straight([0, 2 * WIDTH + offset], [LENGTH, 2 * WIDTH + offset], lines=(N, L)))
    return net


def spots(network: Network) -> list[int]:
    """The left lane of each of the three parts of the road, in driving order."""
    return [network.number(start, end, 0) for start, end in (("a", "b"), ("b", "c"), ("c", "d"))]
