"""How far the unit is that this process carries out: its track says so, and the executor passes it on."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

EVERY_S = 0.5
"""Least time between two calls of a listener."""
_listener: ContextVar[Callable[[float], None] | None] = ContextVar("listener", default=None)


def share_done(share: float) -> None:
    """Say which share of the unit is done, in [0, 1]. Nothing happens where nobody listens."""
    if listener := _listener.get():
        listener(share)


@contextmanager
def listening(listener: Callable[[float], None]) -> Iterator[None]:
    """Pass what `share_done` says within the block to `listener`, at most every `EVERY_S` seconds."""
    last = time.monotonic()

    def seldom(share: float) -> None:
        nonlocal last
        if time.monotonic() - last >= EVERY_S:
            last = time.monotonic()
            listener(share)

    token = _listener.set(seldom)
    try:
        yield
    finally:
        _listener.reset(token)
