"""The rooms of the house: an import goes down, never up and never to a neighbour on the same floor."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from tests.tree import FOLDERS, ROOT

FLOORS = (
    {"compiled", "errors", "exports", "identity", "scenarios"},
    {"bounded", "documents", "files", "isolation", "latex", "recording", "terminal"},
    {"archive", "core"},
    {"checks", "formats", "records", "statistics", "zoo"},
    {"detection", "driving", "run"},
    {"attacks", "cli", "defenses", "envs", "gym", "leaderboard"},
    {"api"},
)
"""The packages and modules of `cavbench`, from the ground up, as in docs/concepts.md."""
TRACKS = ("driving", "detection")
KINDS = ("attacks", "defenses")
WORLDS = {"envs.highway": "driving", "envs.camera": "detection"}


def modules() -> dict[str, Path]:
    """Every module of cavbench, without `cavbench.`, and its file; a package goes by its own name."""
    found = {}
    for folder, place in FOLDERS.items():
        for path in (ROOT / folder).rglob("*.py"):
            inner = path.relative_to(ROOT / folder).with_suffix("").parts
            found[".".join((*place.split("/")[1:], *inner)).removesuffix(".__init__")] = path
    return found


MODULES = modules()


def imports() -> Iterator[tuple[str, str]]:
    """Every import within cavbench, types included: the importing and the imported module."""
    for own, path in MODULES.items():
        for node in ast.walk(ast.parse(path.read_bytes())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("cavbench."):
                base = (node.module or "").removeprefix("cavbench.")
                inner = [f"{base}.{one.name}" for one in node.names]
                yield from ((own, name if name in MODULES else base) for name in inner)
            elif isinstance(node, ast.Import):
                named = [one.name for one in node.names if one.name.startswith("cavbench.")]
                yield from ((own, name.removeprefix("cavbench.")) for name in named)


IMPORTS = sorted(set(imports()))


def room(module: str) -> str:
    return module.partition(".")[0]


def floor(name: str) -> int:
    return next(number for number, rooms in enumerate(FLOORS) if name in rooms)


@pytest.mark.parametrize("own", sorted({room(own) for own, _ in IMPORTS} - {"__init__", "__main__"}))
def test_a_room_imports_only_from_below(own: str) -> None:
    others = {room(other) for module, other in IMPORTS if room(module) == own} - {own}
    assert {other for other in others if floor(other) >= floor(own)} == set()


def track(module: str) -> str:
    """The track that a module belongs to; empty for none."""
    first, _, rest = module.partition(".")
    if first in KINDS:
        first = rest.partition(".")[0]
    return first if first in TRACKS else next((own for world, own in WORLDS.items() if module.startswith(world)), "")


def test_the_tracks_do_not_know_each_other() -> None:
    assert [(own, other) for own, other in IMPORTS if {track(own), track(other)} == set(TRACKS)] == []


def test_there_is_no_circle() -> None:
    graph: dict[str, set[str]] = {}
    for own, other in IMPORTS:
        graph.setdefault(own, set()).add(other)
    TopologicalSorter(graph).prepare()


def test_only_doors_and_reports_of_a_track_name_one() -> None:
    neutral = {"checks", "cli", "core", "identity", "isolation", "records", "recording", "run", "statistics", "zoo"}
    assert [(own, other) for own, other in IMPORTS if room(own) in neutral and track(other)] == []
