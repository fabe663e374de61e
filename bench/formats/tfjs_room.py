"""How much a graph of a stranger may compute: the numbers of all its values together."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from cavbench.formats.trial import RefusedError

TIMES, AT_LEAST = 2000, 2**26
"""Values may have so many times as many numbers as the input together, and so many in any case."""
_left: ContextVar[list[int] | None] = ContextVar("left", default=None)


@contextmanager
def limited(given: int) -> Iterator[None]:
    """Limit what is made within the block to what an input of so many numbers allows."""
    mark = _left.set([max(TIMES * given, AT_LEAST)])
    try:
        yield
    finally:
        _left.reset(mark)


def room(sides: Iterable[int]) -> None:
    """Ask for room for a value of these sides before it is made.

    Raises:
        RefusedError: if there is none.
    """
    left = _left.get()
    if left is not None:
        listed = [int(side) for side in sides]
        left[0] -= math.prod(listed) if min(listed, default=0) >= 0 else 0
        if left[0] < 0:
            raise RefusedError("its values have too many numbers for its input")
