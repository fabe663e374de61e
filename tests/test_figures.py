"""The figures of the documentation are reproducible."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("matplotlib")

from docs.figures.__main__ import FIGURES, FOLDER, make

LARGEST, ALL = 150_000, 2_000_000
"""Largest size in bytes of one figure, and of all."""


@pytest.mark.parametrize("file", ["victim_blind.svg", "victim_dqn.svg"])
def test_a_figure_is_made_the_same_again(file: str, tmp_path: Path) -> None:
    first = make(file, tmp_path).read_bytes()
    assert make(file, tmp_path).read_bytes() == first


def test_a_figure_of_published_records_is_the_one_that_ships(tmp_path: Path) -> None:
    """No network computes anything in it, so it does not depend on the machine."""
    assert make("victim_blind.svg", tmp_path).read_bytes() == (FOLDER / "victim_blind.svg").read_bytes()


def test_every_figure_ships_and_is_small() -> None:
    sizes = [(FOLDER / file).stat().st_size for file in FIGURES]
    assert min(sizes) > 0
    assert max(sizes) < LARGEST
    assert sum(sizes) < ALL
