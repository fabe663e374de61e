"""The leaderboard over worlds on the terminal, as files, and on the page: from the records of a folder."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import jsonschema
import pyarrow.parquet as pq
import pytest
from rich.console import Console

from cavbench.documents import schema
from cavbench.leaderboard.page.write import write
from cavbench.records import store
from tests.command import Bench
from tests.leaderboard.several_worlds import attacked, references

MEANS = {"dqn": {"merge": 0.6, "my_world": 0.5, "exit": 0.3}, "planner": {"merge": 0.8, "exit": 0.4}}


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A results folder: `dqn` in three worlds, one of them a plug-in's without perfect information, and `planner` in two."""
    folder = tmp_path_factory.mktemp("worlds") / "results"
    store.prepare(folder)
    worlds = sorted(MEANS["dqn"])
    tables = [one for victim in MEANS for world, mean in MEANS[victim].items() for one in attacked(victim, world, mean)]
    tables += [one for world in worlds for one in references(world, perfect=None if world == "my_world" else 0.9)]
    for number, records in enumerate(tables):
        pq.write_table(records, folder / store.FOLDER / f"{number}.parquet")
    return folder


def test_the_terminal_has_the_rank_the_worst_world_and_what_a_row_lacks(bench: Bench, out: Path) -> None:
    for name in ("worlds", "leaderboard"):
        said = bench("report", name, f"out={out}")
        assert said.code == 0, said.err
        assert "driving over worlds, relative 0.1" in said.out
        assert "planner has no rank. my_world: not driven" in said.out
    lines = [line.split() for line in said.out.partition("over worlds")[2].splitlines()]
    (first,) = (words for words in lines if words[:2] == ["1", "none"])
    assert first[2] == "dqn"
    assert first[6] == "exit"


def test_one_world_is_too_few_and_one_line_says_so(bench: Bench, tmp_path: Path) -> None:
    store.prepare(tmp_path)
    for number, records in enumerate([*attacked("dqn", "merge", 0.5), *references("merge")]):
        pq.write_table(records, tmp_path / store.FOLDER / f"{number}.parquet")
    said = bench("report", "worlds", f"out={tmp_path}")
    assert said.code == 2
    assert said.err.splitlines() == [
        "error: no defended victim was attacked in two worlds under the same threat model; drive it in another one with world="
    ]
    assert "over worlds" not in bench("report", "leaderboard", f"out={tmp_path}").out


def test_the_files_say_the_same_and_keep_to_the_schema(bench: Bench, out: Path, tmp_path: Path) -> None:
    targets = {key: tmp_path / f"worlds.{key}" for key in ("json", "csv", "latex")}
    said = bench("report", "worlds", f"out={out}", *(f"{key}={path}" for key, path in targets.items()))
    assert said.code == 0, said.err
    made = json.loads(targets["json"].read_text())
    jsonschema.Draft202012Validator(schema()).validate(made)
    (board,) = made["worlds"]
    first, last = board["rows"]
    assert (first["name"], first["rank"], last["rank"], last["mean"]) == ("dqn", 1, None, None)
    assert first["mean"]["estimate"] == pytest.approx(
        sum(one["share"] for one in first["worlds"].values()) / 3, abs=1e-4
    )
    assert first["worlds"]["my_world"]["perfect"] == 1
    lines = list(csv.DictReader(targets["csv"].open()))
    assert [(line["victim"], line["world"], line["lacks"]) for line in lines] == [
        (victim, world, "not driven" * (victim == "planner" and world == "my_world"))
        for victim in ("dqn", "planner")
        for world in sorted(MEANS["dqn"])
    ]
    assert "Mean over worlds" in targets["latex"].read_text()


def test_the_page_shows_it_and_a_filter_keeps_it(browser: Any, out: Path, tmp_path: Path) -> None:
    write(out, tmp_path / "page.html", Console(file=(tmp_path / "said").open("w")))
    page = browser.new_page()
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto((tmp_path / "page.html").as_uri())
    rows = page.locator("#worlds tbody tr")
    assert [row.split() for row in rows.locator("th").all_inner_texts()] == [["dqn"], ["planner"]]
    assert page.locator("#worlds thead th").all_inner_texts()[:4] == [
        "Rank",
        "Defended victim",
        "Mean over worlds",
        "Worst world",
    ]
    assert "planner has no rank" in page.locator("#worlds-notes").inner_text()
    page.locator("#victim").select_option("planner")
    assert rows.locator("th").all_inner_texts() == ["planner"]
    assert errors == []
    page.close()
