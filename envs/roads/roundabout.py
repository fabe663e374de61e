"""The roads of the roundabout: highway-env's envs/roundabout_env.py. Nodes: (s)outh, (e)ast, (n)orth, (w)est; (e)ntry, e(x)it."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from cavbench.envs.roads.network import Line, Network, Way, circular, sine, straight

RADIUS, GAP = 20.0, 4.0
"""Radius in m of the inner lane of the ring, and how much larger the next one is."""
ALPHA = 24
"""Angle in degrees between the middle of an arm and the nodes of the ring."""
BEHIND_EXIT = 20.0
"""The goal is so far behind the end of the road that leaves the ring, in m."""
ACCESS, DEV, SWING = 170, 85, 5
"""Lengths in m: how far the arms reach, how far the roads bend, and by how much."""
DESTINATIONS = ("exr", "sxr", "nxr", "exs", "nxs", "wxs")
"""Nodes to which routes are planned: the first three are those of the other cars, the others of the ego."""
RIGHT, STRAIGHT, LEFT = 3, 4, 5
"""Destinations of the ego, which comes from the south; highway-env's is straight on."""
SOUTH, WEST_OUTER, WEST_INNER, EAST, ENTRIES = 0, 1, 2, 3, 4
"""Columns of `ROAD.spots`: the ego's lane, the lanes on which highway-env's other cars start, and three arms for more."""

C, S, N = Line.CONTINUOUS, Line.STRIPED, Line.NONE


def placed(radius: float) -> tuple[float, float]:
    """For a ring of `radius` m: the angle `ALPHA` in degrees, and by how much the arms are moved outwards, in m."""
    if radius == RADIUS:
        return ALPHA, 0.0
    outer, own = radius + GAP, RADIUS + GAP
    angle = np.arcsin(own * np.sin(np.deg2rad(ALPHA)) / outer)
    return float(np.rad2deg(angle)), float(outer * np.cos(angle) - own * np.cos(np.deg2rad(ALPHA)))


def way(goal: int) -> Way:
    """The way from the south to a destination of the ego; it ends 20 m after the ring's exit road."""
    parts = ("se", "ex", "ee", "nx", "ne", "wx", "we", "sx", "se")
    leaves = {RIGHT: "ex", STRAIGHT: "nx", LEFT: "wx"}[goal]
    last = parts.index(leaves)
    along = tuple(pairwise(parts[: last + 1]))
    others = tuple((f"{arm}s", f"{arm}r") for arm in ("sx", "ex", "nx", "wx") if arm != leaves)
    # On the first part behind its exit a car may still be on its way out.
    behind = tuple(pairwise(parts[last + 1 : -1]))
    roads = (("ser", "ses"), ("ses", "se"), *along, (leaves, f"{leaves}s"), (f"{leaves}s", f"{leaves}r"))
    return Way(roads=roads, goal=BEHIND_EXIT, astray=(*others, *behind))


def ring(net: Network, radius: float, alpha: float) -> None:
    """The eight parts of the ring, each of two lanes."""
    nodes = ("se", "ex", "ee", "nx", "ne", "wx", "we", "sx", "se")
    arcs = (
        (90 - alpha, alpha),
        (alpha, -alpha),
        (-alpha, -90 + alpha),
        (-90 + alpha, -90 - alpha),
        (-90 - alpha, -180 + alpha),
        (-180 + alpha, -180 - alpha),
        (180 - alpha, 90 + alpha),
        (90 + alpha, 90 - alpha),
    )
    for lane, lines in enumerate(((C, S), (N, C))):
        for part, (first, last) in enumerate(arcs):
            arc = circular(
                [0, 0],
                radius + GAP * lane,
                float(np.deg2rad(first)),
                float(np.deg2rad(last)),
                clockwise=False,
                lines=lines,
            )
            net.add(nodes[part], nodes[part + 1], arc)


def roundabout(*, connected: bool, radius: float = RADIUS) -> Network:
    """RoundaboutEnv._make_road; a ring of another radius in m moves the arms outwards, so that they meet it in the same way."""
    net = Network(connected)
    alpha, shift = placed(radius)
    ring(net, radius, alpha)
    dev, a = DEV, SWING
    delta = 0.2 * dev
    reach = dev - delta
    w = 2 * np.pi / dev
    half, near, access = dev / 2 + shift, dev / 2 - delta + shift, ACCESS + shift
    enter, leave = -np.pi / 2, -np.pi / 2 + w * reach
    both = (C, C)
    net.add("ser", "ses", straight([2, access], [2, half], lines=(S, C)))
    net.add("ses", "se", sine([2 + a, half], [2 + a, near], a, w, enter, lines=both))
    net.add("sx", "sxs", sine([-2 - a, near], [-2 - a, half], a, w, leave, lines=both))
    net.add("sxs", "sxr", straight([-2, half], [-2, access], lines=(N, C)))

    net.add("eer", "ees", straight([access, -2], [half, -2], lines=(S, C)))
    net.add("ees", "ee", sine([half, -2 - a], [near, -2 - a], a, w, enter, lines=both))
    net.add("ex", "exs", sine([near, 2 + a], [half, 2 + a], a, w, leave, lines=both))
    net.add("exs", "exr", straight([half, 2], [access, 2], lines=(N, C)))

    net.add("ner", "nes", straight([-2, -access], [-2, -half], lines=(S, C)))
    net.add("nes", "ne", sine([-2 - a, -half], [-2 - a, -near], a, w, enter, lines=both))
    net.add("nx", "nxs", sine([2 + a, -near], [2 + a, -half], a, w, leave, lines=both))
    net.add("nxs", "nxr", straight([2, -half], [2, -access], lines=(N, C)))

    net.add("wer", "wes", straight([-access, 2], [-half, 2], lines=(S, C)))
    net.add("wes", "we", sine([-half, 2 + a], [-near, 2 + a], a, w, enter, lines=both))
    net.add("wx", "wxs", sine([-near, -2 - a], [-half, -2 - a], a, w, leave, lines=both))
    net.add("wxs", "wxr", straight([-half, -2], [-access, -2], lines=(N, C)))
    return net


def spots(network: Network) -> list[int]:
    """The lanes of `SOUTH`, `WEST_OUTER`, `WEST_INNER`, `EAST` and the three of `ENTRIES`."""
    return [
        network.number("ser", "ses", 0),
        network.number("we", "sx", 1),
        network.number("we", "sx", 0),
        network.number("eer", "ees", 0),
        *(network.number(f"{arm}er", f"{arm}es", 0) for arm in "enw"),
    ]
