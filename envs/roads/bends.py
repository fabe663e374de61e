"""The way round on a network whose roads follow one another, for policies that reckon on it (`cavbench.driving.way`)."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from cavbench.driving.way import Stretch, Way
from cavbench.envs.roads.network import Lane, LaneKind, Network


def way_round(
    network: Network,
    roads: tuple[tuple[str, str], ...],
    *,
    start: tuple[float, float],
    start_lane: int | None = None,
    closed: bool = False,
) -> Way:
    """The way along roads, pairs of nodes in driving order, by their left lanes.

    A stretch ends where the next one begins. By how much they then differ is the way's `misfit`: to the side, and along
    the other lanes.

    Args:
        network: the network.
        roads: as many lanes on each.
        start, start_lane, closed: of `Way`.
    """
    parts = [network.graph[first][last] for first, last in roads]
    stretches = [_stretch(lanes[0]) for lanes in parts]
    misfit = kink = 0.0
    following = [*pairwise(range(len(parts))), *([(len(parts) - 1, 0)] if closed else [])]
    for number, after in following:
        one, other = stretches[number], stretches[after]
        ends = [_seen_from(lane, onto.position(0.0, 0.0)) for lane, onto in zip(parts[number], parts[after], strict=True)]
        stretches[number] = Stretch(
            x=one.x, y=one.y, heading=one.heading, length=ends[0][0], curvature=one.curvature
        )
        # The other lanes end elsewhere: as far as the difference is not that of a bend.
        for place, (along, across) in enumerate(ends):
            width = parts[number][place].width
            wanted = ends[0][0] * (1 - one.curvature * place * width)
            misfit = max(misfit, math.hypot(along - wanted, across))
        turned = one.heading + one.curvature * ends[0][0] - other.heading
        kink = max(kink, abs((turned + math.pi) % (2 * math.pi) - math.pi))
    small = 1e-6
    return Way(
        stretches=tuple(stretches),
        lanes=len(parts[0]),
        start=start,
        start_lane=start_lane,
        closed=closed,
        misfit=misfit if misfit > small else 0.0,
        kink=kink if kink > small else 0.0,
    )


def _stretch(lane: Lane) -> Stretch:
    if lane.kind == LaneKind.SINE:
        raise ValueError("a way has straight and circular lanes only")
    bent = lane.kind == LaneKind.CIRCULAR
    x, y = (float(value) for value in lane.position(0.0, 0.0))
    heading = lane.start_phase + lane.turn * math.pi / 2 if bent else lane.heading
    return Stretch(x=x, y=y, heading=heading, length=lane.length, curvature=lane.turn / lane.radius if bent else 0.0)


def _seen_from(lane: Lane, point: np.ndarray) -> tuple[float, float]:
    """A point near the end of a lane as m along it and m to its right."""
    if lane.kind != LaneKind.CIRCULAR:
        x, y = point - lane.start
        return float(x * lane.direction[0] + y * lane.direction[1]), float(y * lane.direction[0] - x * lane.direction[1])
    x, y = point - lane.center
    middle = lane.start_phase + lane.turn * lane.length / lane.radius / 2
    turned = (math.atan2(y, x) - middle + math.pi) % (2 * math.pi) - math.pi
    return lane.turn * turned * lane.radius + lane.length / 2, lane.turn * (lane.radius - math.hypot(x, y))
