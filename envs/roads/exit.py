"""The roads of the exit: highway-env's envs/exit_env.py."""

from __future__ import annotations

import numpy as np

from cavbench.envs.roads.network import WIDTH, Network, Way, circular

LENGTH, EXIT_PLACE, EXIT_LENGTH, EXIT_RADIUS = 1000.0, 400.0, 100.0, 150.0
"""Of the motorway and of the lane to the exit, in m."""
DESTINATIONS = ("3",)
WAY = Way(roads=(("0", "1"), ("1", "2"), ("2", "exit")), goal=20.0, astray=(("2", "3"),), sideways=50.0)
"""The way of the ego, to 20 m behind the beginning of the exit; beyond it, the motorway does not lead there.

A lane to the right counts as much as 50 m, so that a car that looks four seconds ahead begins to change lanes in time."""
START, EXIT_LANE, RAMP = 0, 1, 2
"""Columns of `ROAD.spots`: the first lane, the lane to the exit, and the exit."""


def exit_road(*, lanes: int, connected: bool) -> Network:
    """ExitEnv._create_road; the more to the right a lane is, the lower is its speed limit."""
    net = Network(connected)
    net.add_straight("0", "1", lanes, 0.0, EXIT_PLACE, 30.0)
    net.add_straight("1", "2", lanes + 1, EXIT_PLACE, EXIT_LENGTH, 30.0)
    net.add_straight("2", "3", lanes, EXIT_PLACE + EXIT_LENGTH, LENGTH - EXIT_PLACE - EXIT_LENGTH, 30.0)
    for _, _, members in net.roads():
        for number, lane in enumerate(members):
            lane.speed_limit = 26 - 3.4 * number
    center = [EXIT_PLACE + EXIT_LENGTH, lanes * WIDTH + EXIT_RADIUS]
    net.add("2", "exit", circular(center, EXIT_RADIUS, 3 * np.pi / 2, 2 * np.pi, forbidden=True))
    return net


def spots(network: Network) -> list[int]:
    """The lanes of `START`, `EXIT_LANE` and `RAMP`."""
    last = len(network.graph["1"]["2"]) - 1
    return [network.number("0", "1", 0), network.number("1", "2", last), network.number("2", "exit", 0)]


def spacing_factor(lanes: int) -> float:
    """Vehicle.create_random's factor that reduces the spacing with more lanes."""
    return float(np.exp(-5 / 40 * lanes))
