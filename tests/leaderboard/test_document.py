"""The files for other tools say what the page says, and keep to the published schema."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import jsonschema
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from full_house import driving
from synthetic import drive

from bench.errors import UserError
from bench.records import store as results
from leaderboard.cards import run_command
from leaderboard.document import CSV, document, schema
from leaderboard.entries import MEASUREMENTS, read_entries
from leaderboard.flags import FLAGS
from leaderboard.page import NAME, write
from leaderboard.published import published
from leaderboard.ranking import read_boards


def test_the_document_keeps_to_its_schema(site: Path) -> None:
    made = json.loads((site / "leaderboard.json").read_text())
    validator = jsonschema.Draft202012Validator(schema())
    validator.check_schema(schema())
    validator.validate(made)
    ranked = {key for board in made["boards"] for row in board["rows"] for key in row["pairs"]}
    assert {pair["key"] for pair in made["pairs"]} >= ranked
    del made["boards"][0]["rows"][0]["score"]
    with pytest.raises(jsonschema.ValidationError, match="'score' is a required property"):
        validator.validate(made)


def test_what_a_pair_did_is_the_mean_of_what_it_did_in_its_cells(site: Path) -> None:
    made = json.loads((site / "leaderboard.json").read_text())
    for pair in made["pairs"]:
        rate = "crashed" if pair["track"] == "driving" else "ran"
        whole = {rate: pair["measures"][rate]["estimate"], "queries": pair["queries"]}
        for name, value in whole.items():
            assert value == pytest.approx(np.mean([cell[name] for cell in pair["cells"]]), abs=1e-4)


def test_the_schema_knows_every_flag() -> None:
    assert schema()["$defs"]["flag"]["properties"]["name"]["enum"] == list(FLAGS)


def test_the_table_has_a_line_a_ranked_row(site: Path) -> None:
    made = json.loads((site / "leaderboard.json").read_text())
    with (site / "leaderboard.csv").open() as file:
        lines = list(csv.DictReader(file))
    rows = [row for board in made["boards"] for row in board["rows"]]
    assert list(lines[0]) == list(CSV)
    assert [float(line["score"]) for line in lines] == [row["score"]["estimate"] for row in rows]
    assert [line["flagged"] == "true" for line in lines] == [row["flagged"] for row in rows]


def test_the_terminal_says_the_ranking(site: Path) -> None:
    text = (site / "terminal.txt").read_text()
    assert "driving in highway, relative 0.1, access scores, 1000 queries" in text
    assert "best blind policy" in text
    assert "flagged masked dqn: a black-box attack beats the white-box one" in " ".join(text.split())
    assert max(map(len, text.splitlines()[:-4])) <= 120


def test_compact_records_give_the_same_as_those_in_memory(site: Path) -> None:
    measurements = {name for names in MEASUREMENTS.values() for name in names}
    compact = read_entries(results.read_compact(site / "results", measurements))
    whole = read_entries({track: results.read(site / "results", track=track) for track in ("driving", "detection")})
    scores = [
        {(entry.track, *map(str, entry.identity.values())): entry.score for entry in each} for each in (compact, whole)
    ]
    assert scores[0] == scores[1]


def test_a_card_says_what_to_type() -> None:
    entry = next(one for one in read_entries({"driving": driving()}) if one.identity["attack"] == "pgd")
    words = run_command(entry).split()
    assert words[:3] == ["bench", "run", "attack=pgd"]
    assert {"attack.steps=10", "threat.budget=0.1", "lanes=3,4,5", "density=1,2", "episodes=20", "seeds=0,1,2"} <= set(
        words
    )


def test_older_records_are_read_and_say_that_nothing_was_probed() -> None:
    records = published("driving")
    assert records.schema.equals(results.SCHEMAS["driving"])
    older = records.drop_columns([field.name for field in results.PROBES])
    assert results.upgraded(older, "driving")["same_answer"].null_count == records.num_rows


def test_a_folder_without_records_is_refused_and_so_is_a_place_that_cannot_be_written(
    tmp_path: Path, site: Path
) -> None:
    from rich.console import Console

    with pytest.raises(UserError, match="there are no records in"):
        write(tmp_path, tmp_path / NAME, Console())
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="cannot be written"):
        write(site / "results", tmp_path / "file" / NAME, Console())


def test_reference_drivers_of_both_types_of_action_stand_apart() -> None:
    own = {"discrete": ("dqn", 0.4), "continuous": ("ddpg", 0.1)}
    records = [
        table
        for kind, (victim, blind) in own.items()
        for table in (
            drive(victim, action_type=kind, episodes=3),
            drive(victim, action_type=kind, episodes=3, attack="noise"),
            drive("blind", action_type=kind, episodes=3, sees=False, skill=blind, victim_params={"policy": kind}),
        )
    ]
    (board,), _ = read_boards({"driving": pa.concat_tables(records)})
    names = ["best blind policy, discrete", "best blind policy, continuous"]
    assert list(board.references) == names
    better, worse = (board.references[name].column("safe_progress").mean() for name in names)
    assert better > worse


def test_a_curve_is_about_the_cells_that_all_its_points_have() -> None:
    clean, few, many = (
        drive(attack=attack, skill=skill, threat=("relative", budget), queries=44.0)
        for attack, skill, budget in (("none", 0.8, 0.1), ("zo", 0.5, 0.05), ("zo", 0.3, 0.1))
    )
    part = (pc.field("lanes") == 3) & (pc.field("weather") == "clear")
    boards, entries = read_boards({"driving": pa.concat_tables([clean, few.filter(part), many])})
    (curve,) = document(boards, entries, None)["curves"]
    only = read_entries({"driving": pa.concat_tables([clean, few, many]).filter(part)})
    wanted = {entry.identity["threat_budget"]: entry.score.estimate for entry in only if entry.attacked}
    assert curve["cells"] == 2
    assert {point["x"]: point["estimate"] for point in curve["points"]} == pytest.approx(wanted, abs=1e-4)
    assert curve["clean"]["estimate"] == pytest.approx(only[0].clean_score.estimate, abs=1e-4)
