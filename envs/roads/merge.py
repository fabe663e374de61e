"""The roads of the merge: a motorway with an on-ramp, highway-env's envs/merge_env.py.

`classic` is highway-env's `merge-v0` and `merge-v1`; `generic` is its `merge-generic-v0` and `v1`, whose cars and lengths vary.
"""

from __future__ import annotations

import numpy as np

from cavbench.envs.roads.network import WIDTH, Line, Network, sine, straight

AMPLITUDE = 3.25
"""Half the distance in m by which the ramp comes closer to the motorway."""
UNUSED_AFTER = 90.0
"""How much of the motorway after the merge highway-env does not drive, in m; it must be at least so long."""
CLASSIC_END = 370.0
"""Place in m at which `classic` ends."""
FIRST, RAMP, MERGING = 0, 1, 2
"""Columns of `ROAD.spots`: the first lane of the motorway, the ramp, and the lane whose slow cars cost reward."""

C, S, N = Line.CONTINUOUS_LINE, Line.STRIPED, Line.NONE


def classic(*, connected: bool) -> Network:
    """MergeEnv._make_road; the speed limit is 20 m/s, which no car on the motorway keeps at the start."""
    net = Network(connected)
    ends = (150, 80, 80, 150)
    marks, merging = ((C, S), (N, C)), ((C, S), (N, S))
    for lane in range(2):
        y = lane * WIDTH
        net.add("a", "b", straight([0, y], [sum(ends[:2]), y], lines=marks[lane]))
        net.add("b", "c", straight([sum(ends[:2]), y], [sum(ends[:3]), y], lines=merging[lane]))
        net.add("c", "d", straight([sum(ends[:3]), y], [sum(ends), y], lines=marks[lane]))
    ramp = straight([0, 6.5 + 4 + 4], [ends[0], 6.5 + 4 + 4], lines=(C, C), forbidden=True)
    curve = sine(
        ramp.position(ends[0], -AMPLITUDE),
        ramp.position(sum(ends[:2]), -AMPLITUDE),
        AMPLITUDE,
        2 * np.pi / (2 * ends[1]),
        np.pi / 2,
        lines=(C, C),
        forbidden=True,
    )
    start = curve.position(ends[1], 0)
    net.add("j", "k", ramp)
    net.add("k", "b", curve)
    net.add("b", "c", straight(start, start + np.array([ends[2], 0]), lines=(N, C), forbidden=True))
    return net


def generic(*, lanes: int, before: float, converge: float, parallel: float, after: float, connected: bool) -> Network:
    """MergeGenericEnv._make_road; lengths in m."""
    net = Network(connected)
    net.add_straight("a", "b", lanes, 0.0, before + converge, 30.0)
    net.add_straight("b", "c", lanes, before + converge, parallel, 30.0)
    net.add_straight("c", "d", lanes, before + converge + parallel, after, 30.0)
    beside = lanes * WIDTH
    away = beside + 2 * AMPLITUDE
    options = {"forbidden": True, "speed_limit": 30.0}
    net.add("j", "k", straight([0, away], [before, away], lines=(C, C), **options))
    curve = sine(
        [before, beside + AMPLITUDE],
        [before + converge, beside + AMPLITUDE],
        AMPLITUDE,
        2 * np.pi / (2 * converge),
        np.pi / 2,
        lines=(C, C),
        **options,
    )
    net.add("k", "b", curve)
    merging = straight([before + converge, beside], [before + converge + parallel, beside], lines=(S, C), **options)
    net.add("b", "c", merging)
    return net


def spots(network: Network) -> list[int]:
    """The lanes of `FIRST`, `RAMP` and `MERGING`; highway-env fines slow cars on the third lane, be it the ramp or not."""
    merging = network.number("b", "c", 2) if len(network.graph["b"]["c"]) > 2 else -1
    return [network.number("a", "b", 0), network.number("j", "k", 0), merging]
