"""`bench`, `--version`, `list`, `help` and shell completion."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields
from io import StringIO

import pytest
from rich.console import Console

import cavbench
from cavbench.cli.completion import completed
from cavbench.cli.explain import heading_of, print_term
from cavbench.cli.options_help import THREAT, settings
from cavbench.core import sets
from cavbench.core.pair import choose
from cavbench.core.registry import GROUPS, KINDS, entries
from cavbench.core.track import tracks
from cavbench.detection.threat import PatchThreat
from cavbench.driving.threat import ObservationThreat
from cavbench.run.options import RunOptions
from cavbench.run.progress import RunProgress
from tests.command import Said

Bench = Callable[..., Said]
COMMAND = "import sys; sys.argv = ['bench']; from cavbench.__main__ import main; main()"


def test_bench_alone_shows_its_commands(bench: Bench) -> None:
    said = bench()
    assert (said.code, said.err) == (0, "")
    assert "run" in said.out
    assert "audit" in said.out


def test_the_version_is_that_of_the_package(bench: Bench) -> None:
    assert bench("--version").out == f"cavbench {cavbench.__version__}\n"


def test_every_component_is_listed_with_what_it_does(bench: Bench) -> None:
    found = json.loads(bench("list", "--json").out)["components"]
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
    assert {one["kind"] for one in json.loads(bench("list", "suite", "--json").out)["components"]} == {"suite"}


@pytest.mark.parametrize(
    ("term", "part"),
    [
        ("kept", "attacked score divided by the clean score"),
        ("min TTC", "smallest time to collision"),
        ("safe_progress", "column of driving records"),
        ("threat.budget", "size of the perturbation set"),
        ("threat.presence", "threat.presence.hidden real cars that may be hidden at once"),
        ("threat.traffic.headway", "room at the beginning of a manoeuvre"),
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
    from cavbench.core.track import tracks

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
        ("bench run threat.held.", 2, {"threat.held.share=", "threat.held.longest="}),
    ],
)
def test_the_shell_completes_options(words: str, place: int, found: set[str]) -> None:
    asked = {"COMP_WORDS": words, "COMP_CWORD": str(place), "_BENCH_COMPLETE": "complete_bash"}
    said = subprocess.run(
        [sys.executable, "-c", COMMAND], env=os.environ | asked, capture_output=True, text=True, check=False
    )
    assert set(said.stdout.split()) == found, said.stderr


def test_help_and_completion_know_the_sets_that_the_threat_models_have() -> None:
    for one in tracks():
        model = choose("victim", one.victim).component.threat
        assert one.sets == sets.of(model)
    every = {f"threat.{name}.{item.name}=" for one in tracks() for name in one.sets for item in fields(one.sets[name])}
    assert every <= set(completed("threat."))


def test_every_column_of_the_tables_is_explained() -> None:
    for one in tracks():
        for measure in one.measures:
            console = Console(file=StringIO(), width=300)
            print_term(heading_of(measure), console)
            assert console.file.getvalue()  # type: ignore[attr-defined]
    for heading in ("kept", "worst cell", "strongest per cell", "against best blind", "best blind", "[95 %]"):
        print_term(heading, Console(quiet=True))


def test_help_names_every_option_with_the_default_that_it_has() -> None:
    shown = {name: default for name, default, _ in settings(RunOptions)}
    defaults = RunOptions()
    assert set(shown) - {"ray.address"} == {item.name for item in fields(RunOptions)} - {"ray"}
    for name in ("executor", "out", "reference", "shard", "unit_timeout"):
        assert shown[name] == str(getattr(defaults, name)).lower()
    for name, (text, _) in THREAT.items():
        driving, _, detection = text.partition("; ")
        for threat, default in ((ObservationThreat(), driving), (PatchThreat(), detection or driving)):
            if hasattr(threat, name):
                assert default == f"{value:g}" if isinstance(value := getattr(threat, name), float) else str(value)


def test_an_unknown_name_is_refused_before_torch_is_imported() -> None:
    command = (
        "import sys; sys.argv = ['bench', 'run', 'attack=zzo']; from cavbench.__main__ import main\n"
        "try:\n    main()\nfinally:\n    print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "False\n")
    assert "unknown attack 'zzo'; did you mean 'zo'?" in done.stderr


def test_the_bar_moves_within_a_unit_and_never_back() -> None:
    progress = RunProgress(Console(file=StringIO(), force_terminal=True, width=80))
    progress.begin(episodes=100, finished=10)
    (task,) = progress.bar.tasks
    for share, expected in ((0.25, 20), (0.5, 30), (0.1, 30)):
        progress.preparing("a unit", share, "", 40)
        assert task.completed == expected


def test_a_narrow_bar_keeps_its_count_and_eta() -> None:
    out = StringIO()
    console = Console(file=out, force_terminal=True, width=80)
    with RunProgress(console) as progress:
        progress.begin(episodes=12345, finished=0)
        progress.bar.update(progress.task, completed=77, description="a very long name of a unit " * 5)
        progress.bar.refresh()
    line = next(
        line
        for line in re.split(r"[\r\n]", re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", out.getvalue()))
        if "77/12345" in line
    )
    assert len(line) <= 80
    assert "ETA" in line
    assert "━" in line
