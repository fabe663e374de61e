"""`bench compare`, and a run in a continuous integration: gates with an exit code of their own, JUnit XML, and a summary."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import jsonschema
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from cavbench.documents import schema
from tests.command import Bench

TOY = (
    "victim=toy",
    "world=toy",
    "lanes=3,4",
    "density=1",
    "weather=clear",
    "seeds=0",
    "executor=serial",
    "reference=false",
)
VALID = jsonschema.Draft202012Validator(schema())


@pytest.fixture
def summary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "summary.md"
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(path))
    monkeypatch.chdir(tmp_path)
    return path


def test_a_run_that_passes_and_one_that_does_not(bench: Bench, summary: Path) -> None:
    run = ("run", "attack=nudge", *TOY, "episodes=4", "out=first")
    passed = bench(*run, "fail_below=0.0001", "junit=reports/first.xml")
    assert passed.code == 0, passed.err
    assert "## cavbench: passed" in summary.read_text()
    failed = bench(*run, "fail_below=1", "junit=reports/first.xml")
    assert failed.code == 3
    assert "is below fail_below=1" in failed.err
    suites = ElementTree.parse("reports/first.xml").getroot()
    assert (suites.get("tests"), suites.get("failures"), suites.get("errors")) == ("1", "1", "0")
    (case,) = suites.iter("testcase")
    assert (case.get("name"), case.get("classname")) == ("nudge", "driving.toy")
    assert case.find("failure") is not None
    assert "## cavbench: not passed" in summary.read_text()


def test_a_run_is_compared_with_an_earlier_one(bench: Bench, summary: Path) -> None:
    bench("run", "attack=nudge", *TOY, "episodes=12", "out=first")
    again = bench("run", "attack=nudge", *TOY, "episodes=12", "out=second", "against=first", "junit=j.xml", "--json")
    assert again.code == 0, again.err
    assert json.loads(again.out)["document"] == "run"
    assert "No row is significantly better or worse" in summary.read_text()
    names = [case.get("name") for case in ElementTree.parse("j.xml").getroot().iter("testcase")]
    assert names == ["nudge", "against first"]
    compared = bench("compare", "first", "second", "--json")
    VALID.validate(made := json.loads(compared.out))
    assert {row["verdict"] for row in made["rows"]} == {"same"}
    assert bench("compare", "first", "second", "--markdown").out.startswith("###")
    shown = bench("compare", "first", "second")
    assert (shown.code, "no attack" in shown.out) == (0, True)


def test_a_run_that_is_worse_than_before_does_not_pass(bench: Bench, summary: Path) -> None:
    run = ("run", "attack=nudge", *TOY, "episodes=12")
    bench(*run, "out=first")
    for path in Path("first/episodes").glob("*.parquet"):
        records = pq.read_table(path)
        column, better = records.schema.get_field_index("safe_progress"), pc.add(records["safe_progress"], 0.3)
        records = records.set_column(column, records.schema.field(column), pc.min_element_wise(better, 1.0))
        pq.write_table(records, path)
    said = bench(*run, "out=second", "against=first", "junit=j.xml")
    assert said.code == 3, said.err
    assert "significantly worse than first: nudge on toy" in said.err
    failed = [
        case.get("name")
        for case in ElementTree.parse("j.xml").getroot().iter("testcase")
        if case.find("failure") is not None
    ]
    assert failed == ["against first"]
    assert "✗ worse" in summary.read_text()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("fail_below=2",), "at most 1"),
        (("fail_below=nan",), "at most 1"),
        (("fail_below=x",), "must be a number"),
        (("against=nowhere",), "is no folder"),
        (("against=here",), "the folder that this run writes"),
        (("against=",), "write against=FOLDER"),
        (("junit=here",), "is a folder"),
        (("against=empty",), "no records"),
    ],
)
def test_gates_that_cannot_be_are_refused_before_anything_is_driven(
    bench: Bench, summary: Path, words: tuple[str, ...], said: str
) -> None:
    Path("here").mkdir()
    Path("empty").mkdir()
    refused = bench("run", "attack=nudge", *TOY, "out=here", *words)
    assert (refused.code, refused.out) == (2, "")
    assert said in refused.err
    assert list(Path("here").iterdir()) == []


@pytest.mark.parametrize(
    "words", [(), ("a",), ("a", "b", "c"), ("nowhere", "published"), ("dqn", "dqn", "--json", "--markdown")]
)
def test_sources_that_are_none_are_refused(bench: Bench, summary: Path, words: tuple[str, ...]) -> None:
    refused = bench("compare", *words)
    assert (refused.code, refused.out) == (2, "")
    assert len(refused.err.strip().splitlines()) == 1
