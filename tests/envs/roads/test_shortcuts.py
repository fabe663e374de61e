"""What the engine does not compute would have given the same bits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from cavbench.compiled import entry_point
from cavbench.envs.roads.lanes import is_on, local_coordinates
from cavbench.envs.roads.motion import SURELY_FULL, SURELY_STEEP
from cavbench.envs.roads.originals import original
from cavbench.envs.roads.power import power
from cavbench.envs.roads.state import Floats
from cavbench.envs.roads.traffic import is_aside

NUMBERS, PLACES = 300_000, 20_000


@entry_point
def powers(bases: Floats, exponent: float, out: Floats) -> None:
    """`out` [N] = `bases` [N] ** `exponent`."""
    for number in range(bases.size):
        out[number] = power(bases[number], exponent)


@entry_point
def places(
    roads: NDArray[np.void], lane: int, x: Floats, y: Floats, aside: NDArray[np.bool_], on: NDArray[np.bool_]
) -> None:
    """Which points [N] are surely not on a lane, and which are on it."""
    own = roads[0].lanes[lane]
    for number in range(x.size):
        aside[number] = is_aside(own, x[number], y[number])
        along, across = local_coordinates(own, x[number], y[number])
        on[number] = is_on(own, along, across, own.margin)


@pytest.mark.parametrize("exponent", [4.0, 3.7])
def test_powers_are_those_of_the_c_library(exponent: float) -> None:
    generator = np.random.default_rng(0)
    shares = [generator.uniform(low, high, NUMBERS // 3) for low, high in ((0.0, 1.0), (0.9, 1.1), (1.0, 4.0))]
    # Squares of numbers with few digits, and powers that lie between two numbers, are the hard ones to round.
    few = np.arange(1, 20_000) / 8192
    edges = np.array([0.0, 1.0, 5e-324, 1e-80, 1e-6, 1e-5, 1e5, 1e70, np.inf, np.nan])
    bases = np.concatenate([*shares, few, edges])
    ours = np.zeros(len(bases))
    powers(bases, exponent, ours)
    theirs = np.array([math.pow(base, exponent) for base in bases])
    assert ours.tobytes() == theirs.tobytes()


@pytest.mark.parametrize("task", ["roundabout-v0", "u-turn-v0", "racetrack-v0", "merge-v0", "intersection-v0"])
def test_no_body_on_a_lane_is_called_aside(task: str) -> None:
    roads, generator = original(task).scenes[0].road, np.random.default_rng(1)
    lanes = roads[0]["lanes"][: roads[0]["lane_count"]]
    bent = np.flatnonzero(lanes["kind"] == 2)
    for number in bent.tolist() or [0]:
        lane = lanes[number]
        center = lane["center_x"], lane["center_y"]
        reach = lane["radius"] + 10 if len(bent) else 100.0
        # Anywhere, and as close to the edges of the lane as numbers allow.
        distance = generator.uniform(0, reach, PLACES)
        edge = lane["radius"] + generator.choice([-1, 1], PLACES) * (lane["width"] / 2 + lane["margin"])
        distance = np.where(generator.random(PLACES) < 0.5, distance, edge + generator.normal(size=PLACES) * 1e-9)
        ends = lane["start_phase"] + lane["turn"] / max(lane["radius"], 1.0) * (
            generator.choice([-5.0, lane["length"] + 5.0], PLACES) + generator.normal(size=PLACES) * 1e-9
        )
        angle = np.where(generator.random(PLACES) < 0.5, generator.uniform(-np.pi, np.pi, PLACES), ends)
        x, y = center[0] + distance * np.cos(angle), center[1] + distance * np.sin(angle)
        aside, on = np.zeros(PLACES, np.bool_), np.zeros(PLACES, np.bool_)
        places(roads, number, x, y, aside, on)
        assert not (aside & on).any()
        # A bound that found nothing aside would prove nothing.
        assert on.any()
        assert aside[~on].mean() > 0.3


def test_angles_that_are_cut_need_no_last_bits() -> None:
    assert math.asin(SURELY_STEEP) > np.pi / 4
    assert math.atan(2 * math.tan(math.asin(SURELY_FULL))) > np.pi / 3
