"""The files for other tools say what the page says, and keep to the published schema."""

from __future__ import annotations

import csv
import json
import shlex
from importlib.resources import files
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from typer.main import get_command

from cavbench.cli.main import app
from cavbench.cli.words import split
from cavbench.core.pair import choose
from cavbench.core.track import tracks
from cavbench.errors import UserError
from cavbench.leaderboard.comparisons.naming import labels, varying
from cavbench.leaderboard.comparisons.reading import measurements, read_tracks
from cavbench.leaderboard.page.cards import run_command
from cavbench.leaderboard.page.document import document, schema
from cavbench.leaderboard.page.table import CSV
from cavbench.leaderboard.page.write import NAME, write
from cavbench.leaderboard.ranking.boards import read_boards
from cavbench.leaderboard.ranking.flags import FLAGS
from cavbench.records import reading
from cavbench.run.config import plan_of
from cavbench.scenarios import Cell
from cavbench.statistics.episodes import as_text
from tests.leaderboard.full_house import driving
from tests.leaderboard.synthetic import CLEAR, drive


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
        failure = made["tracks"][pair["track"]]["failure"]
        whole = {"failed": pair["measures"][failure]["estimate"], "queries": pair["queries"]}
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
    assert "driving in highway, standard-v1, relative 0.1, access scores, 1000 queries" in text
    assert "best blind policy" in text
    assert "flagged masked dqn: an attack without gradients beats those with them" in " ".join(text.split())
    assert max(map(len, text.splitlines()[:-4])) <= 120


def test_compact_records_give_the_same_as_those_in_memory(site: Path) -> None:
    needed = {name for each in tracks() for name in measurements(each)}
    compact = read_tracks(reading.read_compact(site / "results", needed))
    whole = read_tracks(reading.read_all(site / "results"))
    scores = [{(one.track, *map(str, one.identity.values())): one.score for one in each} for each in (compact, whole)]
    assert scores[0] == scores[1]


def test_a_card_says_what_to_type() -> None:
    attacked = next(one for one in read_tracks({"driving": driving()}) if one.identity["attack"] == "pgd")
    words = run_command(attacked).split()
    assert words[:3] == ["bench", "run", "attack=pgd"]
    assert {"attack.steps=10", "threat.budget=0.1", "lanes=3,4,5", "density=1,2", "episodes=20", "seeds=0,1,2"} <= set(
        words
    )


def test_the_command_of_a_chain_gives_the_parameters_of_its_links_and_the_grid() -> None:
    chain = choose("defense", "tracker+shield")
    records = drive(defense=chain.name, defense_params=json.loads(chain.params), grid="standard-v2", episodes=10)
    (one,) = read_tracks({"driving": records})
    config = plan_of(shlex.split(run_command(one))[2:])
    assert [pair.defense for pair in config.pairs] == [chain]
    assert (config.grid.name, config.grid.episodes) == ("standard-v2", 10)


def test_a_label_leaves_out_what_is_empty() -> None:
    behind = [drive(victim_params={"behind": name}) for name in ("", "shield", "tracker")]
    found = labels(read_tracks({"driving": pa.concat_tables(behind)}), "victim")
    assert set(found.values()) == {"dqn", "dqn behind=shield", "dqn behind=tracker"}


def test_two_components_have_two_labels_even_if_the_rarer_one_has_an_empty_parameter() -> None:
    usual, rare = drive(victim_params={"behind": "shield"}), drive(victim_params={"behind": ""})
    found = labels(read_tracks({"driving": pa.concat_tables([usual, rare.slice(0, rare.num_rows // 2)])}), "victim")
    assert set(found.values()) == {"dqn", "dqn behind=shield"}


def test_a_parameter_is_shown_only_where_components_of_the_same_name_differ_in_it() -> None:
    driven = [
        drive(victim=name, victim_params={"hidden": hidden}) for name, hidden in (("dqn", 1), ("ppo", 2), ("ppo", 3))
    ]
    assert varying(read_tracks({"driving": pa.concat_tables(driven)}), "victim") == {"ppo": {"hidden"}}


def _value(params: dict[str, Any], name: str) -> object:
    """A parameter; `LINK.NAME` in a chain."""
    link, _, inner = name.partition(".")
    return params[link][inner] if inner else params[name]


def test_every_published_run_command_makes_the_same_pair_on_the_same_scenarios() -> None:
    made = json.loads((files("cavbench.leaderboard") / "index.json").read_text())
    assert len(made["pairs"]) > 100
    for pair in made["pairs"]:
        card = pair["card"]
        config = plan_of(shlex.split(card["run"])[2:])
        (found,) = config.pairs
        for kind, component in card["components"].items():
            chosen = getattr(found, kind)
            # A parameter that is younger than the records has its default.
            same = {name: _value(json.loads(chosen.params), name) for name in component["params"]}
            assert (chosen.name, same) == (component["name"], component["params"]), card["run"]
        assert {name: found.threat.columns[f"threat_{name}"] for name in pair["threat"]} == pair["threat"]
        assert list(config.seeds) == card["training_seeds"]
        verb, *words = shlex.split(card["replay"])[1:]
        options = get_command(app).commands[verb].make_context("view", words).params
        names, where = split(options["words"], (), names=1)
        assert names == [card["pair"]]
        first = pair["cells"][0]["cell"]
        assert {name: where[name] for name in first} == {
            name: f"{value:g}" if isinstance(value, float) else str(value) for name, value in first.items()
        }
        assert {cell for one in pair["cells"] for cell in [Cell(**one["cell"])]} <= set(config.grid.cells())


def test_a_folder_without_records_is_refused_and_so_is_a_place_that_cannot_be_written(
    tmp_path: Path, site: Path
) -> None:
    from rich.console import Console

    with pytest.raises(UserError, match="there are no records in"):
        write(tmp_path, tmp_path / NAME, Console())
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="cannot be written"):
        write(site / "results", tmp_path / "file" / NAME, Console())


def test_baselines_of_both_types_of_action_stand_apart() -> None:
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
    assert list(board.baselines) == names
    better, worse = (board.baselines[name].column("safe_progress").mean() for name in names)
    assert better > worse


def test_a_curve_is_about_the_cells_that_all_its_points_have() -> None:
    clean, few, many = (
        drive(attack=attack, skill=skill, threat=("relative", budget), queries=44.0)
        for attack, skill, budget in (("none", 0.8, 0.1), ("zo", 0.5, 0.05), ("zo", 0.3, 0.1))
    )
    cells = [as_text(cell) for cell in CLEAR if cell.lanes == 3]
    part = pc.field("cell").isin(cells)
    boards, comparisons = read_boards({"driving": pa.concat_tables([clean, few.filter(part), many])})
    (curve,) = document(boards, comparisons, None)["curves"]
    only = read_tracks({"driving": pa.concat_tables([clean, few, many]).filter(part)})
    wanted = {one.identity["threat_budget"]: one.score.estimate for one in only if one.is_attacked}
    assert [cell["lanes"] for cell in curve["cells"]] == [3, 3]
    assert {point["x"]: point["estimate"] for point in curve["points"]} == pytest.approx(wanted, abs=1e-4)
    assert curve["clean"]["estimate"] == pytest.approx(only[0].clean_score.estimate, abs=1e-4)
