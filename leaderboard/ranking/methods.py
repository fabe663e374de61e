"""What is the same defended victim in several worlds, although a policy has other weights where it was trained anew."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from cavbench.core.registry import Kind
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
        defense, victim: names, with the parameters that tell it from others of its name.
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


Part = tuple[str, tuple[tuple[str, str], ...]]
"""The name of a component, and the parameters that are no defaults."""
Key = tuple[Part, Part, str, bool]
"""Defence, victim, home, and whether it is a user's own."""


def world_name(board: Board) -> str:
    """The world of a leaderboard, with the parameters that are no defaults."""
    return _written(_part("world", *board.world))


def methods(boards: Mapping[str, Board]) -> dict[Method, dict[str, Row]]:
    """The rows of leaderboards by method, then by world.

    A policy that was trained in `highway` and drives everywhere is one method; one that was trained in each world is another.
    Its row in `highway` is in both. What is a part of another method, or the same, is left out.

    Args:
        boards: of one threat model, by the name of their world.
    """
    found: dict[Key, dict[str, Row]] = {}
    for world, board in boards.items():
        for row in board.rows:
            for key in _keys(row, board):
                # The first is the one that ranks higher, where records of several versions of a component make two.
                found.setdefault(key, {}).setdefault(world, row)
    kept: dict[Key, dict[str, Row]] = {}
    # Of equal ones the one with a name for its home.
    for key in sorted(found, key=lambda one: (-len(found[one]), one[2] == EACH, one)):
        rows = found[key]
        others = (other for one, other in kept.items() if (one[:2], one[3]) == (key[:2], key[3]))
        if not any(rows.items() <= other.items() for other in others):
            kept[key] = rows
    defenses, victims = _titles([key[0] for key in kept]), _titles([key[1] for key in kept])
    return {Method(defenses[key[0]], victims[key[1]], *key[2:]): rows for key, rows in kept.items()}


def _keys(row: Row, board: Board) -> list[Key]:
    identity = row.identity
    defense = _part("defense", str(identity["defense"]), identity["defense_params"])
    victim = _part("victim", str(identity["victim"]), identity["victim_params"])
    params = parameters(identity["victim_params"])
    if HOME not in params:
        return [(defense, victim, "", row.mine)]
    here, home = world_name(board), _home(str(params[HOME]), board.track.world)
    homes = [home, EACH] if home == here else [home]
    return [(defense, victim, one, row.mine) for one in homes]


def _home(text: str, default: str) -> str:
    """`merge ramp=40`, `vehicles=5` or `highway(preset=thesis)` as tables print a world."""
    if "(" in text or not text:
        return text or default
    words = text.split()
    name, values = (default, words) if "=" in words[0] else (words[0], words[1:])
    pairs = [word.partition("=") for word in values]
    return _written((name, tuple((key, value) for key, _, value in pairs)))


def _part(kind: Kind, name: str, params: object) -> Part:
    """A component with the parameters that are no defaults; a victim without its home."""
    values = {key: _plain(value) for key, value in typed(kind, name, parameters(params)).items() if key != HOME}
    return name, tuple((key, value) for key, value in sorted(values.items()) if value)


def _titles(parts: Sequence[Part]) -> dict[Part, str]:
    """Each component with the parameters in which those of its name differ."""
    found = {}
    for name, own in parts:
        sets = [set(params) for other, params in parts if other == name]
        common = set.intersection(*sets)
        found[name, own] = _written((name, tuple(one for one in own if one not in common)))
    return found


def _written(part: Part) -> str:
    name, params = part
    return f"{name}({', '.join(f'{key}={value}' for key, value in params)})" if params else name


def _plain(value: object) -> str:
    if isinstance(value, Sequence) and not isinstance(value, str):
        return ",".join(map(_plain, value))
    return f"{value:g}" if isinstance(value, float) else str(value)
