"""The compiled random numbers are numpy's, bit for bit."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cavbench.compiled import entry_point
from cavbench.envs.roads.generator import WORDS, next_below, next_normal, next_uniform, seed_generator


@entry_point
def draw(seed: int, bounds: NDArray[np.int64], out: NDArray[np.float64]) -> None:
    """For each of `bounds` a number below it, one of U(-5, 5) for a bound of 0, or a normal one for -1."""
    generator = np.zeros(WORDS, np.uint64)
    seed_generator(generator, seed)
    for number in range(bounds.size):
        if bounds[number] == 0:
            out[number] = next_uniform(generator, -5.0, 5.0)
        elif bounds[number] < 0:
            out[number] = next_normal(generator)
        else:
            out[number] = next_below(generator, bounds[number])


@pytest.mark.parametrize("seed", [0, 1, 7, 1_000_000, 2**31, 2**32 - 1, 2**32, 2**40 + 1, 2**62])
def test_any_sequence_of_draws_equals_numpys(seed: int) -> None:
    bounds = np.random.default_rng(seed + 1).integers(-1, 7, 20_000)
    ours = np.zeros(len(bounds))
    draw(seed, bounds, ours)
    numpys = np.random.default_rng(seed)
    rare = {0: lambda: numpys.uniform(-5.0, 5.0), -1: numpys.normal}
    theirs = [rare[bound]() if bound <= 0 else numpys.integers(bound) for bound in bounds]
    assert (ours == theirs).all()
