"""`bench`, `--version`, `list`, `help` and shell completion."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable

import pytest

import bench as package
from bench.plugins.registry import GROUPS, KINDS, entries
from tests.framework.conftest import Said

Bench = Callable[..., Said]
COMMAND = "import sys; sys.argv = ['bench']; from cavbench import main; main()"


def test_bench_alone_shows_its_commands(bench: Bench) -> None:
    said = bench()
    assert (said.code, said.err) == (0, "")
    assert "run" in said.out
    assert "audit" in said.out


def test_the_version_is_that_of_the_package(bench: Bench) -> None:
    assert bench("--version").out == f"cavbench {package.__version__}\n"


def test_every_component_is_listed_with_what_it_does(bench: Bench) -> None:
    found = json.loads(bench("list", "--json").out)
    names = {(kind, name) for kind in KINDS for name in entries(GROUPS[kind])}
    assert names <= {(one["kind"], one["name"]) for one in found}
    for one in found:
        assert 10 < len(one["summary"]) < 160, one
        assert one["summary"].count("(") == one["summary"].count(")"), one
        assert one["tracks"]


def test_one_kind_is_listed(bench: Bench) -> None:
    said = bench("list", "defense")
    assert "advtrain" in said.out
    assert "pgd" not in said.out
    assert {one["kind"] for one in json.loads(bench("list", "suite", "--json").out)} == {"suite"}
    assert bench("list", "pgd", "--json").code == 2


@pytest.mark.parametrize(
    ("term", "part"),
    [
        ("kept", "attacked score divided by the clean score"),
        ("min TTC", "smallest time to collision"),
        ("safe_progress", "column of driving records"),
        ("threat.budget", "size of the perturbation set"),
        ("attack.restarts", "attack.restarts of pgd"),
        ("zo", "ZO-SignSGD"),
        ("run", "Score attacks on defended victims"),
    ],
)
def test_a_term_is_explained(term: str, part: str, bench: Bench) -> None:
    said = bench("help", *term.split())
    assert said.code == 0, said.err
    assert part in " ".join(said.out.split())


def test_every_heading_of_the_tables_has_an_explanation(bench: Bench) -> None:
    from bench.plugins.track import tracks

    for track in tracks():
        for measure in track.measures:
            if measure.heading.strip():
                assert bench("help", measure.column).code == 0, measure.column
    known = bench("help").out
    for term in ("kept", "best blind", "min TTC", "success", "moved"):
        assert term in known


def test_an_unknown_term_is_one_line(bench: Bench) -> None:
    said = bench("help", "quries")
    assert said.code == 2
    assert said.err.startswith("error: unknown term 'quries'; did you mean 'queries'?")


@pytest.mark.parametrize(
    ("words", "place", "found"),
    [
        ("bench run att", 2, {"attack="}),
        ("bench run attack=pg", 2, {"attack=pgd"}),
        ("bench run attack = pg", 4, {"pgd"}),
        ("bench run weather=clear,f", 2, {"weather=clear,fog"}),
        ("bench aud", 1, {"audit"}),
    ],
)
def test_the_shell_completes_options(words: str, place: int, found: set[str]) -> None:
    asked = {"COMP_WORDS": words, "COMP_CWORD": str(place), "_BENCH_COMPLETE": "complete_bash"}
    said = subprocess.run(
        [sys.executable, "-c", COMMAND], env=os.environ | asked, capture_output=True, text=True, check=False
    )
    assert set(said.stdout.split()) == found, said.stderr
