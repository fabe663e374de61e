"""The roads of the intersection: highway-env's envs/intersection_env.py.

Nodes: (o)uter, (i)nner (r)ight or (l)eft, and the number of the arm.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cavbench.envs.roads.network import WIDTH, Line, Network, Way, circular, straight

ACCESS = 100.0
"""Length of the arms in m."""
SPEED_LIMIT = 10.0
DESTINATIONS = ("o0", "o1", "o2", "o3")
ENTRIES, EXITS = 0, 4
"""The first columns of `ROAD.spots`: the lanes into the crossing, by arm, and those out of it."""

ARRIVED = 25.0
"""The ego has arrived so far behind the crossing, in m."""

N, C, S = Line.NONE, Line.CONTINUOUS, Line.STRIPED


def intersection(*, connected: bool) -> Network:
    """IntersectionEnv._make_road: four arms, of which the horizontal ones have the right of way."""
    right = WIDTH + 5
    left = right + WIDTH
    outer = right + WIDTH / 2
    net = Network(connected)
    for corner in range(4):
        angle = np.radians(90 * corner)
        priority = 3 if corner % 2 else 1
        rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        inner = f"ir{corner}"
        options: dict[str, Any] = {"speed_limit": SPEED_LIMIT, "priority": priority}
        start = rotation @ np.array([WIDTH / 2, ACCESS + outer])
        end = rotation @ np.array([WIDTH / 2, outer])
        net.add(f"o{corner}", inner, straight(start, end, lines=(S, C), **options))
        center = rotation @ np.array([outer, outer])
        first, last = angle + np.radians(180), angle + np.radians(270)
        net.add(inner, f"il{(corner - 1) % 4}", circular(center, right, first, last, lines=(N, C), **options))
        center = rotation @ np.array([-left + WIDTH / 2, left - WIDTH / 2])
        first, last = angle + np.radians(0), angle + np.radians(-90)
        turn = circular(
            center, left, first, last, clockwise=False, lines=(N, N), speed_limit=SPEED_LIMIT, priority=priority - 1
        )
        net.add(inner, f"il{(corner + 1) % 4}", turn)
        start, end = rotation @ np.array([WIDTH / 2, outer]), rotation @ np.array([WIDTH / 2, -outer])
        net.add(inner, f"il{(corner + 2) % 4}", straight(start, end, lines=(S, N), **options))
        start = rotation @ np.flip([WIDTH / 2, ACCESS + outer], axis=0)
        end = rotation @ np.flip([WIDTH / 2, outer], axis=0)
        arm = (corner - 1) % 4
        net.add(f"il{arm}", f"o{arm}", straight(end, start, lines=(N, C), **options))
    return net


def way(goal: int) -> Way:
    """The way of the ego, which comes from arm 0, to another arm."""
    roads = (("o0", "ir0"), ("ir0", f"il{goal}"), (f"il{goal}", f"o{goal}"))
    return Way(roads=roads, goal=ARRIVED, astray=tuple((f"il{arm}", f"o{arm}") for arm in range(4) if arm != goal))


def spots(network: Network) -> list[int]:
    """The lanes of `ENTRIES` and `EXITS`, by arm."""
    entries = [network.number(f"o{arm}", f"ir{arm}", 0) for arm in range(4)]
    return entries + [network.number(f"il{arm}", f"o{arm}", 0) for arm in range(4)]
