"""The angles of steering have the C library's bits."""

from __future__ import annotations

import importlib.util
import itertools
import math
from collections.abc import Callable
from decimal import Decimal, localcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba import njit

from cavbench.compiled import entry_point
from cavbench.envs.roads import angles
from cavbench.envs.roads.angles import SLIP, STEERING, STEPS, evaluated, nearest_point, steered, tangent_pair
from cavbench.envs.roads.motion import SURELY_FULL
from cavbench.envs.roads.state import Floats
from tests.envs.roads.angle_errors import EDGES, measured

NUMBER = 1_000_000
EXACT = Decimal(2) ** -63


@entry_point
def steer(sines: Floats, out: Floats) -> None:
    """[N, 3] angles of the sines [N]."""
    for number in range(sines.size):
        out[number, 0], out[number, 1], out[number, 2] = steered(sines[number])


@entry_point
def call(sines: Floats, out: Floats) -> None:
    """The same from the C library."""
    for number in range(sines.size):
        d = math.atan(2.0 * math.tan(math.asin(sines[number])))
        b = math.atan(0.5 * math.tan(d))
        out[number, 0], out[number, 1], out[number, 2] = d, b, math.sin(b)


@entry_point
def pairs(sines: Floats, out: Floats) -> None:
    """[N, 3, 2] pairs of asin(s), atan(2 tan(asin(s))) and tan(asin(s))."""
    for number in range(sines.size):
        s = sines[number]
        point = nearest_point(s)
        out[number, 0, 0], out[number, 0, 1] = evaluated(point, SLIP, s - point / STEPS)
        out[number, 1, 0], out[number, 1, 1] = evaluated(point, STEERING, s - point / STEPS)
        out[number, 2, 0], out[number, 2, 1], _ = tangent_pair(s)


def angles_of(function: Callable[[Floats, Floats], None], sines: Floats) -> Floats:
    """What a function writes."""
    out = np.zeros((len(sines), 3))
    function(sines, out)
    return out


def sines_between(low: float, high: float, seed: int) -> Floats:
    """`NUMBER` sines of both signs."""
    generator = np.random.default_rng(seed)
    return generator.uniform(low, high, NUMBER) * generator.choice([-1.0, 1.0], NUMBER)


@pytest.mark.parametrize(("low", "high"), [(0.0, SURELY_FULL), (0.1, 0.13), (0.0, 0.07), (0.62, 0.711)])
def test_angles_are_those_of_the_c_library(low: float, high: float) -> None:
    sines = sines_between(low, high, 0)
    assert angles_of(steer, sines).tobytes() == angles_of(call, sines).tobytes()


def test_small_sines_and_those_of_few_digits_too() -> None:
    generator = np.random.default_rng(1)
    small = 10 ** generator.uniform(-300, 0, NUMBER // 4) * 0.66
    few = np.arange(5800) / 8192
    edges = np.array([0.0, -0.0, 5e-324, 1e-100, np.nan, *(k / 2 / STEPS for k in range(180))])
    near = np.nextafter(edges[5:], np.array([[0.0], [1.0]])).ravel()
    sines = np.concatenate([small, few, edges, near])
    assert angles_of(steer, sines).tobytes() == angles_of(call, sines).tobytes()
    # numba's functions are those of Python.
    d = [math.atan(2.0 * math.tan(math.asin(sine))) for sine in few]
    b = [math.atan(0.5 * math.tan(angle)) for angle in d]
    assert angles_of(steer, few).tolist() == [list(row) for row in zip(d, b, map(math.sin, b), strict=True)]


def with_doubt(factor: float) -> Callable[[Floats, Floats], None]:
    """`steer` of a copy of the module whose doubts are multiplied."""
    spec = importlib.util.spec_from_file_location("angles_copy", Path(angles.__file__))
    assert spec is not None
    assert spec.loader is not None
    copy: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(copy)
    copy.TABLE[:, copy.SHARES :] *= factor
    copied = copy.steered

    @njit
    def steer_so(sines: Floats, out: Floats) -> None:
        for number in range(sines.size):
            out[number, 0], out[number, 1], out[number, 2] = copied(sines[number])

    return steer_so  # type: ignore[no-any-return]


@pytest.mark.parametrize("factor", [0.0, 0.2])
def test_with_less_doubt_bits_differ(factor: float) -> None:
    sines = sines_between(0.0, SURELY_FULL, 2)
    assert (angles_of(with_doubt(factor), sines) != angles_of(call, sines)).any(0).all()


def test_the_c_library_is_not_wrong_by_more_than_is_assumed() -> None:
    for number, (low, high) in enumerate(itertools.pairwise(EDGES)):
        errors, assumed = measured(np.random.default_rng(number).uniform(low, high, NUMBER // 10))
        assert (errors < assumed).all(), (low, high)
        # Some results are close to the middle of two numbers, otherwise nothing would be in doubt.
        assert (errors.max(0) > -1e-3).all()


def sine_of(angle: Decimal) -> Decimal:
    """Of a small angle, by its series."""
    total = term = angle
    for n in range(1, 40):
        term *= -angle * angle / (2 * n * (2 * n + 1))
        total += term
    return total


def test_pairs_have_63_bits() -> None:
    generator = np.random.default_rng(3)
    sines = np.concatenate([10 ** generator.uniform(-9, 0, 100) * 0.7, generator.uniform(0, 0.71, 200)])
    out = np.zeros((len(sines), 3, 2))
    pairs(sines, out)
    with localcontext() as context:
        context.prec = 60
        for sine, (slip, steering, tangent) in zip(sines, out, strict=True):
            s = Decimal(sine)
            cosine = (1 - s * s).sqrt()
            assert abs(Decimal(tangent[0]) + Decimal(tangent[1]) - s / cosine) < EXACT * s
            # The error of an angle is that of its sine over its cosine.
            found = sine_of(Decimal(slip[0]) + Decimal(slip[1]))
            assert abs(found - s) / cosine < EXACT * s
            wanted = 2 * s / (1 + 3 * s * s).sqrt()
            found = sine_of(Decimal(steering[0]) + Decimal(steering[1]))
            assert abs(found - wanted) / (1 - wanted * wanted).sqrt() < EXACT * wanted
