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


@entry_point
def parted(x, weights, inputs, outputs, first, y, start, used):  # type: ignore[no-untyped-def]
    tiles.part(x, weights, 0, inputs, 1, inputs, outputs, first, y, start, used, True)


@entry_point
def pooled(response, present, start, number, best, chosen):  # type: ignore[no-untyped-def]
    for p in range(len(best)):
        tiles.pool(response, present, start, number, best, chosen, p)


def test_a_tile_begins_with_what_it_is_given_and_is_rectified() -> None:
    generator = np.random.default_rng(2)
    x, first = (generator.normal(size=(rows, 64)).astype(np.float32) for rows in (5, 11))
    weights, y = generator.normal(size=55).astype(np.float32), np.full((11, 64), 7, np.float32)
    expected = first.copy()
    plain(x, weights, 0, 5, 1, 5, 11, expected, 64)
    before = first.copy()
    parted(x, weights, 5, 11, first, y, 32, np.empty(6, np.int64))
    np.testing.assert_array_equal(y[:, 32:48], np.maximum(expected, 0)[:, 32:48])
    assert (expected[:, 32:48] < 0).any()
    assert (np.delete(y, range(32, 48), 1) == 7).all()
    np.testing.assert_array_equal(first, before)


def test_the_largest_response_is_kept_with_its_car() -> None:
    generator = np.random.default_rng(3)
    response, best = (generator.normal(size=(4, 64)).astype(np.float32) for _ in range(2))
    present, chosen = (generator.random((2, 64)) < 0.7).astype(np.float32), np.full((4, 64), -1, np.float32)
    response[1, 20], best[2, 21] = np.nan, np.nan
    present[0, 20:22] = 1
    found = response * present[0]
    larger = (found > best) | np.isnan(found)
    larger[:, :16] = larger[:, 32:] = False
    expected = np.where(larger, found, best), np.where(larger, 6, chosen)
    pooled(response, present, 16, np.float32(6), best, chosen)
    np.testing.assert_array_equal(best, expected[0])
    np.testing.assert_array_equal(chosen, expected[1])
    assert larger[1, 20]
    assert not larger[2, 21]


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
