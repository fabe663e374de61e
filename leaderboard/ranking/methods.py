"""What is the same defended victim in several worlds, although a policy has other weights where it was trained anew."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cavbench.leaderboard.comparisons.comparison import parameters
from cavbench.leaderboard.comparisons.typed import typed
from cavbench.leaderboard.ranking.boards import Board, Row

EACH = "each world"
"""The home of a policy that was trained in the world that it is scored in."""
HOME = "trained_in"
"""The parameter of a victim that says where it was trained."""


@dataclass(frozen=True, order=True)
class Method:
    """A defended victim, wherever it drives.

    Args:
        defense, victim: names with the parameters that are no defaults.
        home: where it was trained: the name of a world, or `EACH`; empty for one that does not say.
        mine: whether it is of a user's own records, beside published ones.
    """

    defense: str
    victim: str
    home: str
    mine: bool = False

    @property
    def trained(self) -> str:
        """Where it was trained, in words; empty where that is not said."""
        return f"trained in {self.home}" if self.home else ""


def world_name(board: Board) -> str:
    """The world of a leaderboard, with the parameters that are no defaults."""
    return _written("world", *board.world)


def methods(boards: Mapping[str, Board]) -> dict[Method, dict[str, Row]]:
    """The rows of leaderboards by method, then by world.

    A policy that was trained in `highway` and drives everywhere is one method; one that was trained in each world is another.
    Its row in `highway` is in both. What is a part of another method, or the same, is left out.

    Args:
        boards: of one threat model, by the name of their world.
    """
    found: dict[Method, dict[str, Row]] = {}
    for world, board in boards.items():
        for row in board.rows:
            for method in _methods(row, board):
                # The first is the one that ranks higher, where records of several versions of a component make two.
                found.setdefault(method, {}).setdefault(world, row)
    kept: dict[Method, dict[str, Row]] = {}
    # Of equal ones the one with a name for its home.
    for method in sorted(found, key=lambda one: (-len(found[one]), one.home == EACH, one)):
        rows = found[method]
        others = (other for key, other in kept.items() if _named(key) == _named(method))
        if not any(rows.items() <= other.items() for other in others):
            kept[method] = rows
    return kept


def _methods(row: Row, board: Board) -> list[Method]:
    identity = row.identity
    victim = parameters(identity["victim_params"])
    defense = _written("defense", str(identity["defense"]), str(identity["defense_params"]))
    named = _written("victim", str(identity["victim"]), identity["victim_params"])
    if HOME not in victim:
        return [Method(defense, named, "", row.mine)]
    default, here = board.track.world, world_name(board)
    home = _home(str(victim[HOME]), default)
    homes = [home, EACH] if home == here else [home]
    return [Method(defense, named, one, row.mine) for one in homes]


def _home(text: str, default: str) -> str:
    """`merge ramp=40`, `vehicles=5` or `highway(preset=thesis)` as tables print a world."""
    if "(" in text or not text:
        return text or default
    words = text.split()
    name, values = (default, words) if "=" in words[0] else (words[0], words[1:])
    return f"{name}({', '.join(values)})" if values else name


def _named(one: Method) -> tuple[str, str, bool]:
    return one.defense, one.victim, one.mine


def _written(kind: Any, name: str, params: str) -> str:
    """A component with the parameters that are no defaults; a victim without its home."""
    given = parameters(params)
    values = {key: value for key, value in typed(kind, name, given).items() if key != HOME and value != ""}
    words = [f"{key}={_plain(value)}" for key, value in sorted(values.items())]
    return f"{name}({', '.join(words)})" if words else name


def _plain(value: object) -> str:
    if isinstance(value, Sequence) and not isinstance(value, str):
        return ",".join(map(_plain, value))
    return f"{value:g}" if isinstance(value, float) else str(value)
