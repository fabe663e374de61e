"""The road of the two-way overtaking: highway-env's envs/two_way_env.py."""

from __future__ import annotations

from cavbench.envs.roads.network import WIDTH, Line, Network, straight

LENGTH = 800.0
WITH, AGAINST = 0, 1
"""Columns of `ROAD.spots`: the right one of the two lanes to drive on, and the lane of the oncoming traffic."""


def two_way(*, connected: bool = False, length: float = LENGTH) -> Network:
    """TwoWayEnv._make_road: the oncoming traffic drives on the left one of the two lanes."""
    net = Network(connected)
    net.add("a", "b", straight([0, 0], [length, 0], lines=(Line.CONTINUOUS_LINE, Line.STRIPED)))
    net.add("a", "b", straight([0, WIDTH], [length, WIDTH], lines=(Line.NONE, Line.CONTINUOUS_LINE)))
    net.add("b", "a", straight([length, 0], [0, 0], lines=(Line.NONE, Line.NONE)))
    return net


def spots(network: Network) -> list[int]:
    """The lanes of `WITH` and `AGAINST`."""
    return [network.number("a", "b", 1), network.number("b", "a", 0)]
