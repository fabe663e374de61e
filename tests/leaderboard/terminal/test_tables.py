"""What a run's report says, read off the terminal."""

from __future__ import annotations

import io
import re
from datetime import timedelta

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from rich.console import Console

from cavbench.core.track import track
from cavbench.driving.track import BEST_BLIND
from cavbench.leaderboard.comparisons.comparison import Comparison
from cavbench.leaderboard.comparisons.reading import read_comparisons
from cavbench.leaderboard.ranking.boards import read_boards
from cavbench.leaderboard.terminal.run import SCREEN, cells_report, remarks, run_report
from cavbench.leaderboard.terminal.text import CLEAN, estimate, strip, threat
from cavbench.records.schema import schema
from cavbench.scenarios import Cell
from cavbench.statistics.episodes import as_text
from cavbench.statistics.estimates import Interval
from tests.leaderboard.synthetic import CLEAR, GRID, baseline_drivers, drive

SCHEMA = schema(track("driving"))
ZO = {"objective": "expected", "steps": 50}


def printed(records: pa.Table, width: int = 120) -> str:
    """The overview, then cell by cell."""
    return overview(records, width) + cells(records, width)


def overview(records: pa.Table, width: int = 120) -> str:
    out = io.StringIO()
    run_report({"driving": records}, Console(file=out, width=width))
    return out.getvalue()


def cells(records: pa.Table, width: int = 120) -> str:
    out = io.StringIO()
    cells_report({"driving": records}, Console(file=out, width=width))
    return out.getvalue()


def read(records: pa.Table) -> list[Comparison]:
    return read_comparisons(records, track("driving"))


def one_pair(**changes: object) -> pa.Table:
    attacked = {"attack": "zo", "attack_params": ZO, "skill": 0.25, "queries": 1050.0, **changes}
    return pa.concat_tables([drive(), drive(**attacked), baseline_drivers()])  # type: ignore[arg-type]


def test_the_share_of_avoidable_crashes_is_a_column_and_who_is_to_blame_a_line() -> None:
    records = one_pair()
    attacked = pc.equal(records["attack"], "zo").to_numpy()
    crashed = records["crashed"].to_numpy() & attacked
    avoided = crashed & (np.cumsum(crashed) % 4 > 0)
    judged = {"avoidable": np.where(crashed, avoided, np.nan), "avoidable_idm": np.where(crashed, 0.0, np.nan)}
    for name, values in judged.items():
        column = pa.array(values, pa.float64(), from_pandas=True)
        records = records.set_column(records.schema.get_field_index(name), SCHEMA.field(name), column)
    assert re.search(r"zo .* 75 % ", overview(records, 160))
    score = records["safe_progress"].to_numpy()[attacked & ~(crashed & ~avoided)].mean()
    said = f"{avoided.sum()} of {crashed.sum()} crashes could have been avoided (0 by IDM)"
    assert said in cells(records, 160)
    assert f"score without the other crashes: {score:.2f}" in cells(records, 160)
    assert "able" not in overview(one_pair(), 160)


@pytest.mark.parametrize("width", [80, 100, 120, 140])
def test_no_line_is_wider_than_the_terminal_and_no_number_is_cut_off(width: int) -> None:
    text = printed(one_pair(), width)
    assert max(map(len, text.splitlines())) <= width
    assert "…" not in re.sub(r"[−+]\S*…[−+]\S*", "", text)


def test_every_cell_has_a_row_grouped_by_weather() -> None:
    rows = [line.strip() for line in cells(one_pair()).splitlines()]
    for weather in ("clear", "rain", "fog"):
        place = next(i for i, row in enumerate(rows) if row.startswith(weather))
        assert [row[:5] for row in rows[place + 1 : place + 7]] == [
            "3 × 1",
            "3 × 2",
            "4 × 1",
            "4 × 2",
            "5 × 1",
            "5 × 2",
        ]


def test_the_threat_model_and_the_attacks_parameters_are_stated() -> None:
    text = " ".join(cells(one_pair()).split())
    assert "zo objective=expected steps=50" in text
    assert "relative 0.1: each measured value may be off by 10 % of itself" in text
    assert "at most 1000 queries per step" in text


def test_sets_that_all_attacks_have_stand_once_below_the_table_and_others_beside_their_attack() -> None:
    usual = "linf+presence.hidden=9+latency.frames=4+held.share=0.5+actuator.delay=4"
    threats = {"steady": usual, "rude": f"{usual}+dynamics.braking=8+dynamics.lane_gain=-0.2"}
    attacks = [
        drive(attack="fault", attack_params={"mode": mode}, threat=(norm, 0.1)) for mode, norm in threats.items()
    ]
    text = overview(pa.concat_tables([drive(), *attacks, baseline_drivers()]), 80)
    assert text.count("presence.hidden=9") == 1
    assert text.count(" braking=8") == text.count(" lane_gain=-0.2") == 1
    assert re.search(r"mode=steady\s+0\.", text)
    said = "threat: linf 0.1, presence.hidden=9, latency.frames=4, held.share=0.5, actuator.delay=4, access scores,"
    assert said in " ".join(text.split())


def test_the_threat_model_names_each_set_once() -> None:
    (pair,) = read(one_pair(threat=("linf+presence.hidden=9", 0.2)))
    assert threat(pair).startswith("linf 0.2: each")
    assert threat(pair).count("presence.hidden=9") == 1


def test_a_linf_threat_model_is_stated_on_the_normalised_scale() -> None:
    (pair,) = read(one_pair(threat=("linf", 0.2)))
    assert threat(pair).startswith("linf 0.2: each measured value may be off by 0.2 on the [-1, 1] scale")


def test_a_victim_no_better_than_a_blind_policy_is_marked() -> None:
    text = printed(one_pair(skill=0.0))
    assert "no better than the best blind policy in 18 of 18 cells" in text
    assert "no better" not in printed(one_pair(skill=0.6))


def test_the_blind_policy_is_the_best_of_each_cell_and_stands_for_every_weather() -> None:
    (pair,) = read(one_pair())
    blind = pair.baselines[BEST_BLIND]
    assert blind.cells == pair.cells
    records = baseline_drivers()
    for cell in (Cell(lanes=3, density=1.0, weather="fog"), Cell(lanes=5, density=2.0, weather="clear")):
        best = 0.0
        for policy in set(records["victim_params"].to_pylist()) - {"{}"}:
            mask = [
                (row["cell"], row["victim_params"]) == (as_text(cell.replaced(weather="clear")), policy)
                for row in records.to_pylist()
            ]
            best = max(best, float(np.mean(records.filter(pa.array(mask))["safe_progress"].to_numpy())))
        assert blind.only(cells=[cell]).column("safe_progress").mean() == pytest.approx(best)


def test_drivers_of_other_actions_are_no_baseline() -> None:
    continuous = drive("blind", victim_params={"policy": "brake"}, cells=CLEAR, runs=(0,), sees=False, skill=0.9,
                       action_type="continuous")  # fmt: skip
    with_it, without = (read(table)[0] for table in (pa.concat_tables([one_pair(), continuous]), one_pair()))
    assert with_it.baseline_scores == without.baseline_scores


def test_a_sweep_has_one_row_a_pair_the_strongest_attack_first() -> None:
    records = pa.concat_tables(
        [
            one_pair(),
            drive(attack="zo", attack_params={**ZO, "steps": 10}, skill=0.4),
            drive(attack="noise", skill=0.55),
            drive(defense="advtrain", skill=0.5),
            drive(attack="zo", attack_params=ZO, defense="advtrain", skill=0.45),
        ]
    )
    pairs = read(records)
    assert [(pair.identity["defense"], pair.identity["attack"]) for pair in pairs] == [
        ("none", "zo"), ("none", "zo"), ("none", "noise"), ("advtrain", "zo"),
    ]  # fmt: skip
    text = overview(records)
    assert text.index("zo steps=50") < text.index("zo steps=10") < text.index("noise")
    assert text.index("noise") < text.index("dqn + advtrain")
    assert "objective" not in text


def test_attacked_and_clean_are_measured_on_the_same_scenarios() -> None:
    records = pa.concat_tables([drive(episodes=20), drive(attack="zo", skill=0.2, cells=CLEAR[:2], episodes=10)])
    (pair,) = read(records)
    assert pair.clean is not None
    assert pair.attacked is not None
    assert (pair.clean.cells, pair.clean.seeds) == (pair.attacked.cells, pair.attacked.seeds)
    assert len(pair.cells) == 2


def test_a_run_that_broke_off_says_what_is_left_out() -> None:
    whole = drive(attack="zo", skill=0.2)
    late = pa.array([run == 2 and "fog" in cell for run, cell in
                     zip(whole["training_seed"].to_pylist(), whole["cell"].to_pylist(), strict=True)])  # fmt: skip
    (pair,) = read(pa.concat_tables([drive(), whole.filter(pc.invert(late))]))
    assert {cell.weather for cell in pair.cells} == {"clear", "rain"}
    assert any("left out" in remark for remark in remarks(pair))


def test_the_newest_record_of_a_scenario_counts() -> None:
    old, new = drive(cells=CLEAR[:1], runs=(0,)), drive(cells=CLEAR[:1], runs=(0,), skill=0.9)
    later = pa.array(
        [stamp + timedelta(minutes=5) for stamp in new["created_at"].to_pylist()], SCHEMA.field("created_at").type
    )
    new = new.set_column(SCHEMA.get_field_index("created_at"), SCHEMA.field("created_at"), later)
    for records in (pa.concat_tables([old, new]), pa.concat_tables([new, old])):
        (pair,) = read(records)
        assert pair.own.column("safe_progress").mean() == pytest.approx(np.mean(new["safe_progress"].to_numpy()))


def test_clean_runs_and_baseline_drivers_alone_can_be_reported() -> None:
    assert "queries" not in overview(pa.concat_tables([drive(), baseline_drivers()]))
    assert "idm" in printed(drive("idm", runs=(0,), cells=CLEAR, sees=False))


def test_one_cell_one_episode_has_no_interval_but_a_number() -> None:
    cells = GRID.cells()[:1]
    one = {"cells": cells, "runs": (0,), "episodes": 1}
    assert "nan" not in printed(pa.concat_tables([drive(**one), drive(attack="zo", **one)]))  # type: ignore[arg-type]


def test_numbers_are_written_short_and_strips_to_scale() -> None:
    assert estimate(Interval(0.5, 0.25, 1.0)).plain == "0.50 .25–1.00"
    assert estimate(Interval(0.5, np.nan, np.nan)).plain == "0.50"
    assert strip({CLEAN: Interval(0.5, 0.3, 0.7)}, 10).plain == "···──○──··"
    assert strip({CLEAN: Interval(1.0, 1.0, 1.0)}, 4).plain == "···○"


def test_brackets_in_parameters_are_printed_as_they_are() -> None:
    sweep = [drive(attack="zo", attack_params={"speeds": speeds}, skill=0.2) for speeds in (["bold"], ["red"])]
    assert "zo speeds=['bold']" in overview(pa.concat_tables([drive(), *sweep]))


@pytest.mark.parametrize("attacks", [1, 3, 16])
def test_a_run_is_told_on_one_screen_of_80_by_24(attacks: int) -> None:
    records = [drive(), drive(defense="advtrain"), baseline_drivers()]
    for steps in range(1, attacks + 1):
        for defense in ("none", "advtrain"):
            own = {"attack": "zo", "attack_params": {"steps": steps}, "skill": 0.6 - 0.03 * steps, "cells": CLEAR}
            records.append(drive(defense=defense, **own))  # type: ignore[arg-type]
    lines = overview(pa.concat_tables(records), 80).splitlines()
    # The command adds a line, and the prompt is one.
    assert len(lines) + 2 <= SCREEN
    assert max(map(len, lines)) <= 80
    text = "\n".join(lines)
    for word in ("worst cell", "crashed", "best blind policy", "IDM and MOBIL", f"zo steps={attacks}"[:2]):
        assert word in text
    assert ("weaker attacks" in text) == (attacks == 16)
    assert ("strongest per cell" in text) == (attacks > 1)


def test_the_headline_of_several_attacks_is_the_score_that_leaderboards_rank_by() -> None:
    records = pa.concat_tables([one_pair(), drive(attack="noise", skill=0.3)])
    (board, *_), _ = read_boards({"driving": records})
    (line,) = (line for line in overview(records).splitlines() if "strongest per cell" in line)
    assert estimate(board.rows[0].worst.score).plain in line
