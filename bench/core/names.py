"""How components are named: NAME, NAME:CHOICE of an adapter, or NAME+NAME, a chain of defences."""

from __future__ import annotations

MARK = "+"
"""Separates the links of a chain of defences."""


def split(name: str) -> list[str]:
    """The links of a chain of defences."""
    return name.split(MARK)


def plain(name: str) -> str:
    """NAME of NAME:CHOICE."""
    return name.partition(":")[0]
