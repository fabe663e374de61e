"""The files for other tools say what the page says, and keep to the published schema."""

from __future__ import annotations

import csv
import io
import json
import re
import shlex
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from rich.console import Console
from typer.main import get_command

from cavbench.cli.main import app
from cavbench.cli.words import split
from cavbench.core.pair import choose
from cavbench.core.track import tracks
from cavbench.documents import document as enveloped
from cavbench.documents import schema
from cavbench.errors import UserError
from cavbench.leaderboard.comparisons.naming import labels, varying
from cavbench.leaderboard.comparisons.reading import measurements, read_tracks
from cavbench.leaderboard.page import document as document_module
from cavbench.leaderboard.page.cards import run_command
from cavbench.leaderboard.page.document import document
from cavbench.leaderboard.page.run_document import run_content
from cavbench.leaderboard.page.table import BOARD, latex, table
from cavbench.leaderboard.page.write import NAME, html, write
from cavbench.leaderboard.ranking.boards import read_boards
from cavbench.leaderboard.ranking.columns import Column, columns
from cavbench.leaderboard.ranking.flags import FLAGS
from cavbench.leaderboard.terminal import ranking
from cavbench.records import reading
from cavbench.run.config import plan_of
from cavbench.scenarios import Cell
from cavbench.statistics.episodes import as_text
from cavbench.statistics.estimates import share_interval
from tests.leaderboard.full_house import driving
from tests.leaderboard.synthetic import CLEAR, GRID, drive


def test_the_document_keeps_to_its_schema(site: Path) -> None:
    made = json.loads((site / "leaderboard.json").read_text())
    validator = jsonschema.Draft202012Validator(schema())
    validator.check_schema(schema())
    validator.validate(made)
    ranked = {key for board in made["boards"] for row in board["rows"] for key in row["pairs"]}
    assert {pair["key"] for pair in made["pairs"]} >= ranked
    del made["boards"][0]["rows"][0]["values"]
    with pytest.raises(jsonschema.ValidationError, match="'values' is a required property"):
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
    assert list(lines[0])[: len(BOARD)] == list(BOARD)
    assert [float(line["score"]) for line in lines] == [row["values"]["score"]["estimate"] for row in rows]
    assert [float(line["score_low"]) for line in lines] == [row["values"]["score"]["low"] for row in rows]
    assert [bool(line["flags"]) for line in lines] == [row["flagged"] for row in rows]
    assert all(line["average_precision"] == "" for line in lines if line["track"] == "driving")


def test_one_list_of_columns_makes_the_terminal_the_json_the_csv_and_the_latex(
    site: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    more = Column(name="spread", title="Spread", short="spread", meaning="of cells", value=lambda row, called: 0.123456)
    for module in (document_module, ranking):
        monkeypatch.setattr(module, "columns", lambda board: [*columns(board), more])
    found, comparisons = read_boards(reading.read_all(site / "results"))
    made = enveloped("leaderboard", document(found, comparisons, None))
    jsonschema.validate(made, schema())
    said = Console(record=True, width=200, file=io.StringIO())
    ranking.print_boards(found, said)
    assert "spread" in said.export_text()
    assert made["boards"][0]["rows"][0]["values"]["spread"] == 0.1235
    assert {line["spread"] for line in csv.DictReader(io.StringIO(table(made)))} == {"0.1235"}
    assert latex(made).count("Spread") == len(made["boards"])
    assert '"Spread"' in html(made, 1, [], "")


def test_latex_tables_have_a_line_a_row_and_no_letter_that_means_something_to_it(site: Path) -> None:
    made = json.loads((site / "leaderboard.json").read_text())
    text = (site / "leaderboard.tex").read_text()
    assert text == latex(made)
    assert text.count(r"\begin{tabular}") == len(made["boards"])
    heads_and_rows = sum(1 + len(board["rows"]) for board in made["boards"])
    assert text.count(r" \\") == heads_and_rows
    for line in text.splitlines():
        if line.endswith(r" \\"):
            assert line.count(" & ") in {
                len([column for column in board["columns"] if column["shown"]]) - 1 for board in made["boards"]
            }
            assert not re.search(r"(?<!\\)[%#_]", line)


def test_cells_that_share_a_value_of_an_axis_have_an_interval(site: Path) -> None:
    made = json.loads((site / "leaderboard.json").read_text())
    (board, *_), _ = read_boards(reading.read_all(site / "results"))
    for row, said in zip(board.rows, made["boards"][0]["rows"], strict=True):
        for part in said["parts"]:
            places = [n for n, cell in enumerate(row.worst.cells) if cell[part["axis"]] == part["value"]]
            expected = share_interval(row.worst.scores[:, places])
            assert [part["low"], part["estimate"], part["high"]] == pytest.approx(
                [expected.low, expected.estimate, expected.high], abs=1e-4
            )
    assert {(part["axis"], part["value"]) for part in said["parts"]} >= {("weather", "fog"), ("lanes", 3)}


def test_the_terminal_says_the_ranking(site: Path) -> None:
    text = (site / "terminal.txt").read_text()
    assert f"driving in highway, {GRID.name}, relative 0.1, access scores, 1000 queries" in text
    assert "best blind policy" in text
    assert "⚑ number of flags" in text
    assert "Attacks, by what they add" in text
    assert max(map(len, text.splitlines()[:-4])) <= 120


def test_compact_records_give_the_same_as_those_in_memory(site: Path) -> None:
    needed = {name for each in tracks() for name in measurements(each)}
    compact = read_tracks(reading.read_all(site / "results", needed))
    whole = read_tracks(reading.read_all(site / "results"))
    scores = [{(one.track, *map(str, one.identity.values())): one.score for one in each} for each in (compact, whole)]
    assert scores[0] == scores[1]


def test_a_card_says_what_to_type() -> None:
    attacked = next(one for one in read_tracks({"driving": driving()}) if one.identity["attack"] == "pgd")
    words = run_command(attacked).split()
    assert words[:3] == ["bench", "run", "attack=pgd"]
    assert "threat.budget=0.1" in words
    left_out = ("attack.steps=", "defense=", "lanes=", "episodes=", "seeds=")
    assert not [word for word in words if word.startswith(left_out)], "defaults, and the whole of the grid"


def test_a_card_says_which_part_of_the_grid_and_what_is_no_default() -> None:
    own = drive(attack="pgd", attack_params={"steps": 11, "restarts": 4}, cells=CLEAR[:2], runs=(1,), episodes=5)
    (one,) = read_tracks({"driving": own})
    words = run_command(one).split()
    assert {"attack.steps=11", "lanes=3", "weather=clear", "episodes=5", "seeds=1"} <= set(words)
    assert "attack.restarts=4" not in words


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


def test_every_published_run_command_makes_the_same_pair_on_the_same_scenarios(published_site: Path) -> None:
    made = json.loads((published_site / "index.json").read_text())
    assert len(made["pairs"]) > 100
    view = get_command(app).commands["view"]
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
        assert verb == "view"
        options = view.make_context(verb, words).params
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


def test_a_best_blind_policy_that_is_another_in_each_cell_has_no_single_name() -> None:
    skills = {"idle": {3: 0.9, 4: 0.1}, "slower": {3: 0.1, 4: 0.9}}
    cells = {lanes: [as_text(cell) for cell in CLEAR if cell.lanes == lanes] for lanes in (3, 4)}
    blind = [
        drive("blind", sees=False, skill=skill, victim_params={"policy": policy}).filter(
            pc.field("cell").isin(cells[lanes])
        )
        for policy, by_lanes in skills.items()
        for lanes, skill in by_lanes.items()
    ]
    own = [table.filter(pc.field("cell").isin(cells[3] + cells[4])) for table in (drive(), drive(attack="noise"))]
    pairs = run_content({"driving": pa.concat_tables([*own, *blind])}, None)["pairs"]
    mixed = [pair["victim"] for pair in pairs if pair["victim"]["label"] == "best blind policy"]
    assert [one["params"]["policy"] for one in mixed] == [["idle", "slower"]]


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
