"""`--json`: standard output is one document that keeps to the schema, and says what the tables say."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from cavbench.documents import schema
from tests.command import Bench, Said

VALID = jsonschema.Draft202012Validator(schema())
TOY = ("victim=toy", "world=toy", "lanes=3,4", "density=1", "weather=clear", "episodes=4", "seeds=0", "executor=serial")


def read(said: Said, code: int = 0) -> dict[str, Any]:
    assert said.code == code, said.err
    made: dict[str, Any] = json.loads(said.out)
    VALID.validate(made)
    return made


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that the first test fills."""
    return tmp_path_factory.mktemp("driven") / "results"


@pytest.fixture
def driven(bench: Bench, results: Path) -> tuple[dict[str, Any], Path]:
    """What the run said that filled the folder, and the folder, which tests only read."""
    said = results.with_name("said.json")
    if not said.exists():
        said.write_text(json.dumps(read(bench("run", "attack=nudge,noise", *TOY, f"out={results}", "--json"))))
    return json.loads(said.read_text()), results


def test_a_run_says_every_pair_its_control_and_the_baselines(driven: tuple[dict[str, Any], Path]) -> None:
    made, out = driven
    assert (made["document"], made["complete"], made["errors"], made["out"]) == ("run", True, [], str(out))
    roles = [one["role"] for one in made["pairs"]]
    assert roles.count("attacked") == 2
    assert roles.count("clean") == 1
    assert "baseline" in roles
    for one in made["pairs"]:
        assert one["score"]["low"] <= one["score"]["estimate"] <= one["score"]["high"]
        assert len(one["cells"]) == 2
    (strongest,) = made["strongest"]
    attacked = [one["score"]["estimate"] for one in made["pairs"] if one["role"] == "attacked"]
    assert min(attacked) - 1e-9 <= strongest["score"]["estimate"]


def test_show_and_report_say_the_same_as_the_run(driven: tuple[dict[str, Any], Path], bench: Bench) -> None:
    made, out = driven
    shown, reported = read(bench("show", str(out), "--json")), read(bench("report", f"out={out}", "--json"))
    for other in (shown, reported):
        assert {**made, "made": ""} == {**other, "made": ""}
    pair = next(one for one in made["pairs"] if one["attack"]["name"] == "nudge")
    alone = read(bench("show", pair["card"]["pair"], f"out={out}", "--json"))
    assert {one["attack"]["name"] for one in alone["pairs"] if one["role"] == "attacked"} == {"nudge"}
    assert alone["recordings"] == [one for one in made["recordings"] if pair["card"]["pair"] in one]


def test_a_report_is_written_as_json_csv_and_latex_without_a_page(
    driven: tuple[dict[str, Any], Path], bench: Bench, tmp_path: Path
) -> None:
    made, out = driven
    files = {key: tmp_path / f"scores.{key}" for key in ("json", "csv", "latex")}
    words = [f"{key}={path}" for key, path in files.items()]
    said = bench("report", "run", f"out={out}", *words)
    assert said.code == 0, said.err
    assert json.loads(files["json"].read_text())["pairs"] == made["pairs"]
    with files["csv"].open() as file:
        lines = list(csv.DictReader(file))
    assert [float(line["score"]) for line in lines] == [one["score"]["estimate"] for one in made["pairs"]]
    assert files["latex"].read_text().count(r" \\") == 1 + len(made["pairs"])
    bench("report", f"out={out}", f"json={files['json']}", f"csv={files['csv']}")
    ranked = json.loads(files["json"].read_text())
    VALID.validate(ranked)
    with files["csv"].open() as file:
        assert [float(line["score"]) for line in csv.DictReader(file)] == [
            row["values"]["score"]["estimate"] for board in ranked["boards"] for row in board["rows"]
        ]


def test_a_run_whose_component_fails_prints_the_others_and_exits_with_2(bench: Bench, tmp_path: Path) -> None:
    said = bench("run", "attack=nudge", "attack.mood=raise", *TOY, f"out={tmp_path / 'results'}", "--json")
    made = read(said, code=2)
    assert not made["complete"]
    assert "nudge" in " ".join(made["errors"])
    assert {one["role"] for one in made["pairs"]} <= {"clean", "baseline"}
    assert said.err.strip().splitlines()[-1].startswith("error: ")


def test_a_component_is_listed_with_its_parameters_and_a_suite_with_its_members(bench: Bench) -> None:
    (one,) = read(bench("list", "nudge", "--json"))["components"]
    assert next(each for each in one["parameters"] if each["name"] == "attack.pause")["default"] == "0.0"
    (suite,) = read(bench("list", "standard-2", "--json"))["components"]
    assert "pgd" in suite["members"]
    assert read(bench("list", "--json"))["document"] == "list"


def test_a_check_says_what_each_rule_found(bench: Bench) -> None:
    made = read(bench("check", "nudge", "victim=toy", "world=toy", "--json"), code=0)
    assert made["passed"] is True
    assert "pass" in {one["status"] for one in made["components"][0]["outcomes"]}


def test_an_audit_says_both_scores(bench: Bench, tmp_path: Path) -> None:
    words = ("attack=noise", "lanes=3", "density=1", "weather=clear", "episodes=10", "seeds=0", "world.max_steps=6")
    said = bench("audit", *words, "salt=7", "executor=serial", f"out={tmp_path}", "--json")
    made = read(said, code=said.code)
    assert made["salt"] == 7
    assert said.code == int(not made["holds"])
    for one in made["pairs"]:
        assert one["gain"]["estimate"] == pytest.approx(one["public"] - one["drawn"])


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("report", "thesis", "--json"), "report as data"),
        (("report", "csv=."), "is a folder"),
        (("report", "jsn=x.json"), "unknown option"),
        (("show", "nothing", "--json"), "there are no records"),
    ],
)
def test_bad_input_is_one_line_and_no_document(
    words: tuple[str, ...], line: str, bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    said = bench(*words)
    assert (said.code, said.out) == (2, "")
    assert line in said.err
    assert len(said.err.strip().splitlines()) == 1
