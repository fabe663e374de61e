"""What the roads of all layouts have in common."""

from __future__ import annotations

from typing import NamedTuple


class Road(NamedTuple):
    """The road of an episode.

    Args:
        lanes: in the ego's direction.
        rule: who goes first, where roads cross.
    """

    lanes: int
    rule: str = ""


def edge(name: str, row: int) -> str:
    """The name of a stretch of the road of row `row` of the batch."""
    return f"{name}_{row}"
