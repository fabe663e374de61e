"""The figures of the documentation: a command makes them, and makes the same ones again."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import pytest

pytest.importorskip("matplotlib")

from docs.figures.__main__ import FIGURES, FOLDER, make

LARGEST, ALL = 150_000, 3_500_000
"""Bytes of one figure, and of all."""


@pytest.mark.parametrize("file", ["victim_blind.svg", "victim_dqn.svg"])
def test_a_figure_is_made_the_same_again(file: str, tmp_path: Path) -> None:
    first = make(file, tmp_path).read_bytes()
    assert make(file, tmp_path).read_bytes() == first


def test_a_figure_of_published_records_is_the_one_that_ships(tmp_path: Path) -> None:
    """Nothing in it is computed by a network, so it does not depend on the machine."""
    assert make("victim_blind.svg", tmp_path).read_bytes() == (FOLDER / "victim_blind.svg").read_bytes()


@pytest.mark.parametrize("module", sorted({name.split(":")[0] for name in FIGURES.values()}))
def test_the_module_of_every_figure_can_be_used(module: str) -> None:
    functions = [name.split(":")[1] for name in FIGURES.values() if name.split(":")[0] == module]
    used = import_module(f"docs.figures.{module}")
    assert all(callable(getattr(used, function)) for function in functions)


def test_every_figure_is_there_and_small() -> None:
    sizes = [(FOLDER / file).stat().st_size for file in FIGURES]
    assert min(sizes) > 0
    assert max(sizes) < LARGEST
    assert sum(sizes) < ALL
