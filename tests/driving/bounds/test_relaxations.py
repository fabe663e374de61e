from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cavbench.driving.bounds.relaxations import Relaxation, largest, relu, tanh

ends = st.floats(-4, 4, allow_nan=False).map(lambda value: round(value, 3))


@pytest.mark.parametrize(("lines", "function"), [(relu, torch.relu), (tanh, torch.tanh)])
@settings(max_examples=60, deadline=None)
@given(a=ends, b=ends)
def test_the_lines_enclose_the_activation(lines, function, a: float, b: float) -> None:
    low, high = (torch.tensor([end], dtype=torch.float64) for end in (min(a, b), max(a, b)))
    found: Relaxation = lines(low, high)
    x = torch.linspace(min(a, b), max(a, b), 201, dtype=torch.float64)
    assert (found.lower_slope * x + found.lower_offset <= function(x) + 1e-9).all()
    assert (found.upper_slope * x + found.upper_offset >= function(x) - 1e-9).all()


def test_a_relu_that_is_always_on_or_off_is_exact() -> None:
    found = relu(torch.tensor([1.0, -3.0]), torch.tensor([2.0, -1.0]))
    for slope, offset in (found[:2], found[2:]):
        assert torch.equal(slope, torch.tensor([1.0, 0.0]))
        assert torch.equal(offset.abs(), torch.zeros(2))


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), cars=st.integers(1, 5))
def test_the_bounds_of_the_largest_value_hold_in_every_corner_and_between(seed: int, cars: int) -> None:
    random = torch.Generator().manual_seed(seed)
    ends_ = (torch.rand(2, 1, cars, 4, generator=random, dtype=torch.float64) - 0.5) * 4
    low, high = ends_.amin(0), ends_.amax(0)
    found = largest(low, high)
    corners = torch.rand(300, cars, 4, generator=random, dtype=torch.float64)
    corners[:150] = corners[:150].round()
    x = low + (high - low) * corners
    true = x.amax(1).relu()
    assert ((found.lower * x).sum(1) <= true + 1e-12).all()
    assert ((found.upper * x).sum(1) + found.offset >= true - 1e-12).all()


def test_one_car_that_is_always_largest_is_exact() -> None:
    low, high = torch.tensor([[[2.0], [0.0]]]), torch.tensor([[[3.0], [1.0]]])
    found = largest(low, high)
    assert torch.equal(found.lower, torch.tensor([[[1.0], [0.0]]]))
    assert torch.equal(found.upper, torch.tensor([[[1.0], [0.0]]]))
    assert found.offset.item() == pytest.approx(0)
