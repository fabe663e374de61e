"""Tests for the columns of a leaderboard that say what faults do: real episodes of the highway."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from cavbench.api import score
from cavbench.attacks.driving.fault import Fault
from cavbench.core import registry, suites
from cavbench.core.pair import choose
from cavbench.core.suites import Member
from cavbench.leaderboard.comparisons.comparison import Comparison
from cavbench.leaderboard.ranking.boards import read_boards
from cavbench.leaderboard.ranking.columns import columns
from cavbench.leaderboard.ranking.faults import is_fault, of, under_faults
from cavbench.records import reading

ALLOWED = {"presence": {"hidden": 9, "share": 1.0}, "actuator": {"delay": 4, "replaced": 0.5}}


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `noise` and two faults on `dqn`, and `noise` alone on `random`'s neighbour `ppo`."""
    folder = tmp_path_factory.mktemp("faults")
    world = choose("world", "highway", max_steps=10).component
    cell = {"world": world, "lanes": 3, "density": 1.0, "weather": "clear", "episodes": 2, "seeds": [0], "out": folder}
    for victim in ("dqn", "ppo"):
        score(victim, "noise", **cell)
    score("dqn", [Fault(mode="dropout", severity=3), Fault(mode="lost", severity=3)], threat=ALLOWED, **cell)
    return folder


def test_faults_are_columns_beside_the_attacks_and_rank_nothing(out: Path) -> None:
    (board,), _ = read_boards(reading.read_all(out))
    by_victim = {str(row.identity["victim"]): row for row in board.rows}
    assert [str(one.identity["attack"]) for row in board.rows for one in row.attacks] == ["noise", "noise"]
    faults = by_victim["dqn"].faults
    assert faults is not None
    assert faults.faults == 2
    assert by_victim["ppo"].faults is None
    listed = {one.name: one for one in columns(board)}
    values = {name: listed[name].value(by_victim["dqn"], lambda one, kind: "") for name in listed if "faults" in name}
    assert values == {
        "faults_mean": faults.mean,
        "faults_worst": faults.worst,
        "faults_failed": faults.crashed,
        "faults_of_idm": faults.mean / faults.idm,
    }
    assert listed["faults_mean"].value(by_victim["ppo"], lambda one, kind: "") is None


def test_faults_on_less_than_the_row_are_remarked_on(out: Path) -> None:
    (board,), _ = read_boards(reading.read_all(out))
    row = next(row for row in board.rows if row.faults)
    assert row.faults is not None
    assert (row.faults.runs, row.faults.cells, row.faults.scenarios) == (1, 1, 2)
    assert "few_faults" not in {remark.name for remark in row.remarks}
    fewer = replace(row, faults=replace(row.faults, scenarios=1))
    (said,) = [remark.text for remark in fewer.remarks if remark.name == "few_faults"]
    assert (
        said
        == "its columns of faults are of 1 training seed x 1 cell x 1 scenario for each fault, fewer than its score"
    )


def test_a_leaderboard_without_faults_has_no_column_of_them(out: Path) -> None:
    records = {name: table.filter(_is_no_fault(table)) for name, table in reading.read_all(out).items()}
    (board,), _ = read_boards(records)
    assert not [one.name for one in columns(board) if "faults" in one.name]


def test_a_row_with_fewer_faults_than_another_is_unfinished(out: Path) -> None:
    comparisons = [one for one in read_boards(reading.read_all(out))[1] if is_fault(one)]
    (first, second) = comparisons
    other = replace(second, identity={**second.identity, "victim": "ppo"})
    assert [row.faults for _, row in under_faults([first, second])] == [2]
    assert [row.faults for _, row in under_faults([first, second, other])] == [2]


def test_a_row_says_which_version_of_the_suite_it_has(out: Path) -> None:
    one = next(one for one in read_boards(reading.read_all(out))[1] if is_fault(one))

    def like(member: Member, victim: str) -> Comparison:
        words = "".join(f"+{name}={value:g}" for name, value in member.threat.items())
        params = json.dumps({"mode": member.params["mode"], "severity": member.params["severity"]})
        norm = f"{one.identity['threat_norm']}{words}"
        return replace(one, identity={**one.identity, "attack_params": params, "threat_norm": norm, "victim": victim})

    old = [like(member, "ppo") for member in suites.suite("faults-1").members]
    new = [like(member, "dqn") for member in suites.suite("faults-2").members]
    assert {row.suite: row.faults for _, row in under_faults([*old, *new])} == {"faults-1": 27, "faults-2": 33}
    assert {row.suite for _, row in under_faults([*old, *new[:-1]])} == {"faults-1"}
    assert [row.suite for _, row in under_faults([*new, *old[:-1]])] == ["faults-2"]


def test_records_without_a_newer_parameter_are_of_its_default(out: Path) -> None:
    one = next(one for one in read_boards(reading.read_all(out))[1] if is_fault(one))
    params = json.loads(one.identity["victim_params"])
    older = replace(one, identity={**one.identity, "victim_params": json.dumps(params | {"tau": 0.9})})
    missing = {key: value for key, value in params.items() if key != "trained_in"}
    newer = replace(one, identity={**one.identity, "victim_params": json.dumps(missing)})
    faults = under_faults([one])
    assert of(newer, faults) is not None
    assert of(older, faults) is None
    assert of(replace(one, mine=True), faults) is None


def test_the_terminal_shows_them(out: Path) -> None:
    said = io.StringIO()
    report = registry.resolve(registry.REPORTS, "leaderboard", "report")
    report(reading.read_all(out), Console(file=said, width=160))
    assert "faults" in said.getvalue()


def _is_no_fault(table: object) -> object:
    import pyarrow.compute as pc

    return pc.not_equal(table["attack"].cast("string"), "fault")  # type: ignore[index]
