"""The way round on a network whose roads follow one another, for policies that reckon on it (`cavbench.driving.way`)."""

from __future__ import annotations

import math

from cavbench.driving.way import Stretch, Way
from cavbench.envs.roads.network import Lane, LaneKind, Network


def way_round(network: Network, roads: tuple[tuple[str, str], ...], *, start: float, start_lane: int) -> Way:
    """The way along roads, pairs of nodes in driving order, by their left lanes.

    Args:
        network: the network, with as many lanes on each of these roads, parallel and as wide as each other.
        start, start_lane: of `Way`.

    Raises:
        ValueError: if a lane is neither straight nor circular, or the roads do not fit together.
    """
    lanes = [network.graph[first][last] for first, last in roads]
    stretches = tuple(_stretch(members[0]) for members in lanes)
    return Way(stretches=stretches, lanes=len(lanes[0]), start=start, start_lane=start_lane)


def _stretch(lane: Lane) -> Stretch:
    if lane.kind == LaneKind.SINE:
        raise ValueError("a way has straight and circular lanes only")
    bent = lane.kind == LaneKind.CIRCULAR
    x, y = (float(value) for value in lane.position(0.0, 0.0))
    heading = lane.start_phase + lane.turn * math.pi / 2 if bent else lane.heading
    return Stretch(x=x, y=y, heading=heading, length=lane.length, curvature=lane.turn / lane.radius if bent else 0.0)
