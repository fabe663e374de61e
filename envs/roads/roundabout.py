"""The roads of the roundabout: highway-env's envs/roundabout_env.py. Nodes: (s)outh, (e)ast, (n)orth, (w)est; (e)ntry, e(x)it."""

from __future__ import annotations

import numpy as np

from cavbench.envs.roads.network import Line, Network, circular, sine, straight

RADIUS, GAP = 20.0, 4.0
"""Radius in m of the inner lane of the ring, and how much larger the next one is."""
ALPHA = 24
"""Angle in degrees between the middle of an arm and the nodes of the ring."""
ACCESS, DEV, SWING = 170, 85, 5
"""Lengths in m: how far the arms reach, how far the roads bend, and by how much."""
DESTINATIONS = ("exr", "sxr", "nxr", "nxs")
"""Nodes to which routes are planned; the last one is the ego's."""
SOUTH, WEST_OUTER, WEST_INNER, EAST = 0, 1, 2, 3
"""Columns of `ROAD.spots`: the ego's lane, and the lanes on which the other cars start."""

C, S, N = Line.CONTINUOUS, Line.STRIPED, Line.NONE


def ring(net: Network) -> None:
    """The eight parts of the ring, each of two lanes."""
    nodes = ("se", "ex", "ee", "nx", "ne", "wx", "we", "sx", "se")
    arcs = (
        (90 - ALPHA, ALPHA),
        (ALPHA, -ALPHA),
        (-ALPHA, -90 + ALPHA),
        (-90 + ALPHA, -90 - ALPHA),
        (-90 - ALPHA, -180 + ALPHA),
        (-180 + ALPHA, -180 - ALPHA),
        (180 - ALPHA, 90 + ALPHA),
        (90 + ALPHA, 90 - ALPHA),
    )
    for lane, lines in enumerate(((C, S), (N, C))):
        for part, (first, last) in enumerate(arcs):
            arc = circular(
                [0, 0],
                RADIUS + GAP * lane,
                float(np.deg2rad(first)),
                float(np.deg2rad(last)),
                clockwise=False,
                lines=lines,
            )
            net.add(nodes[part], nodes[part + 1], arc)


def roundabout(*, connected: bool) -> Network:
    """RoundaboutEnv._make_road."""
    net = Network(connected)
    ring(net)
    access, dev, a = ACCESS, DEV, SWING
    delta = 0.2 * dev
    reach = dev - delta
    w = 2 * np.pi / dev
    half = dev / 2
    enter, leave = -np.pi / 2, -np.pi / 2 + w * reach
    both = (C, C)
    net.add("ser", "ses", straight([2, access], [2, half], lines=(S, C)))
    net.add("ses", "se", sine([2 + a, half], [2 + a, half - delta], a, w, enter, lines=both))
    net.add("sx", "sxs", sine([-2 - a, -dev / 2 + reach], [-2 - a, half], a, w, leave, lines=both))
    net.add("sxs", "sxr", straight([-2, half], [-2, access], lines=(N, C)))

    net.add("eer", "ees", straight([access, -2], [half, -2], lines=(S, C)))
    net.add("ees", "ee", sine([half, -2 - a], [half - delta, -2 - a], a, w, enter, lines=both))
    net.add("ex", "exs", sine([-dev / 2 + reach, 2 + a], [half, 2 + a], a, w, leave, lines=both))
    net.add("exs", "exr", straight([half, 2], [access, 2], lines=(N, C)))

    net.add("ner", "nes", straight([-2, -access], [-2, -half], lines=(S, C)))
    net.add("nes", "ne", sine([-2 - a, -half], [-2 - a, -dev / 2 + delta], a, w, enter, lines=both))
    net.add("nx", "nxs", sine([2 + a, half - reach], [2 + a, -half], a, w, leave, lines=both))
    net.add("nxs", "nxr", straight([2, -half], [2, -access], lines=(N, C)))

    net.add("wer", "wes", straight([-access, 2], [-half, 2], lines=(S, C)))
    net.add("wes", "we", sine([-half, 2 + a], [-dev / 2 + delta, 2 + a], a, w, enter, lines=both))
    net.add("wx", "wxs", sine([half - reach, -2 - a], [-half, -2 - a], a, w, leave, lines=both))
    net.add("wxs", "wxr", straight([-half, -2], [-access, -2], lines=(N, C)))
    return net


def spots(network: Network) -> list[int]:
    """The lanes of `SOUTH`, `WEST_OUTER`, `WEST_INNER` and `EAST`."""
    return [
        network.number("ser", "ses", 0),
        network.number("we", "sx", 1),
        network.number("we", "sx", 0),
        network.number("eer", "ees", 0),
    ]
