"""Products in tiles have the bits of the plain loops, and leave out only what is 0."""

from __future__ import annotations

import numpy as np
import pytest

from cavbench.compiled import entry_point
from cavbench.driving.fused import kernels, tiles


@entry_point
def tiled(x, weights, at, by_output, by_input, inputs, outputs, y, lanes):  # type: ignore[no-untyped-def]
    tiles.add(x, weights, at, by_output, by_input, inputs, outputs, y, lanes)


@entry_point
def plain(x, weights, at, by_output, by_input, inputs, outputs, y, lanes):  # type: ignore[no-untyped-def]
    kernels.add(x, weights, at, by_output, by_input, inputs, outputs, y, lanes)


@pytest.mark.parametrize("lanes", [16, 48, 64])
@pytest.mark.parametrize(("inputs", "outputs"), [(5, 32), (36, 128), (128, 6), (1, 1), (0, 9)])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("turned", [False, True])
def test_sums_have_the_bits_of_the_plain_loops(
    lanes: int, inputs: int, outputs: int, share: float, turned: bool
) -> None:
    generator = np.random.default_rng(0)
    x = generator.normal(size=(inputs, 64)).astype(np.float32)
    # Some inputs are 0 everywhere, some only in a tile, some only at a point.
    x[generator.random(inputs) < share / 2] = 0
    x[generator.random(inputs) < share / 2, :16] = 0
    x[generator.random(x.shape) < share / 2] = 0
    weights = generator.normal(size=3 + inputs * outputs).astype(np.float32)
    steps = (1, outputs) if turned else (inputs, 1)
    first = generator.normal(size=(outputs, 64)).astype(np.float32)
    found, expected = first.copy(), first.copy()
    tiled(x, weights, 3, *steps, inputs, outputs, found, lanes)
    plain(x, weights, 3, *steps, inputs, outputs, expected, lanes)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(found[:, lanes:], first[:, lanes:])
    matrix = weights[3:].reshape(inputs, outputs).T if turned else weights[3:].reshape(outputs, inputs)
    np.testing.assert_allclose(found[:, :lanes], (first + matrix @ x)[:, :lanes], atol=2e-5)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_nan_and_infinity_are_not_taken_for_nothing(value: float) -> None:
    x, y = np.zeros((3, 64), np.float32), np.zeros((9, 64), np.float32)
    x[1, 17] = value
    tiled(x, np.ones(27, np.float32), 0, 3, 1, 3, 9, y, 64)
    assert not np.isfinite(y[:, 17]).any()
    y[:, 17] = 0
    assert not y.any()
