"""Annotations give the allowed values of parameters; other values are refused in one line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import pytest
from annotated_types import Interval
from hypothesis import given
from hypothesis import strategies as st

from cavbench.core import ranges
from cavbench.core.contracts import Component
from cavbench.core.pair import choose
from cavbench.core.parameters import parameters
from cavbench.core.ranges import Count, NotNegative, Positive, Share
from cavbench.errors import UserError


@dataclass(frozen=True, kw_only=True)
class Ranged(Component):
    """A dataclass with a parameter of every range.

    Args:
        share: of something.
        count: of something.
        positive: number.
        low: number.
        half: open interval.
        name: one of two.
        maybe: a count, or nothing.
        free: anything.
    """

    share: Share = 0.5
    count: Count = 1
    positive: Positive = 1.0
    low: NotNegative = 0.0
    half: Annotated[float, Interval(gt=0, le=2)] = 1.0
    name: Literal["a", "b"] = "a"
    maybe: Count | None = None
    free: float = 0.0


WORDS = {
    "share": "between 0 and 1",
    "count": "at least 1",
    "positive": "above 0",
    "low": "at least 0",
    "half": "in (0, 2]",
    "name": "one of a, b",
    "maybe": "at least 1",
    "free": "",
}


def test_the_allowed_range_of_a_parameter_is_shown() -> None:
    assert {name: parameter.allowed for name, parameter in parameters(Ranged).items()} == WORDS


@given(st.floats(allow_nan=True))
def test_a_share_is_a_number_from_0_to_1(value: float) -> None:
    if 0 <= value <= 1:
        assert Ranged(share=value).share == value
    else:
        with pytest.raises(ValueError, match=r"^share must be between 0 and 1, got "):
            Ranged(share=value)


@pytest.mark.parametrize(
    "wrong",
    [
        {"count": 0},
        {"positive": 0.0},
        {"low": -1e-9},
        {"half": 0.0},
        {"half": 2.1},
        {"name": "c"},
        {"maybe": 0},
        {"count": True},
    ],
)
def test_a_value_out_of_range_is_refused(wrong: dict[str, object]) -> None:
    ((name, value),) = wrong.items()
    with pytest.raises(ValueError) as raised:
        Ranged(**wrong)  # type: ignore[arg-type]
    assert str(raised.value) == f"{name} must be {WORDS[name]}, got {value!r}"


def test_none_is_allowed_if_the_type_allows_it() -> None:
    assert Ranged(maybe=None, free=float("inf")).maybe is None


def test_a_built_in_component_is_checked_where_it_is_chosen() -> None:
    with pytest.raises(UserError, match=r"^attack 'pgd': steps must be at least 1, got 0$"):
        choose("attack", "pgd", steps=0)
    with pytest.raises(UserError, match=r"^defense 'frame_stack': frames must be at least 2, got 1$"):
        choose("defense", "frame_stack", frames=1)


def test_every_bound_of_a_pair_counts() -> None:
    assert ranges.words(Annotated[int, Interval(ge=2, lt=5)]) == "in [2, 5)"
