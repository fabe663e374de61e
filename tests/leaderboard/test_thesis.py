"""Chapter 4 of the thesis beside ours, and what is published."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from rich.console import Console

from cavbench.core.track import Track, track, tracks
from cavbench.errors import UserError
from cavbench.leaderboard.published import publish, published, rounded
from cavbench.leaderboard.thesis import policy_records
from cavbench.leaderboard.thesis.numbers import printed
from cavbench.leaderboard.thesis.policy_records import Source, Wanted
from cavbench.leaderboard.thesis.report import thesis_report
from cavbench.leaderboard.thesis.trend import trend
from cavbench.records import store as results
from cavbench.records.schema import schema
from cavbench.run.config import plan_of
from tests.leaderboard.synthetic import CLEAR, approach, baseline_drivers, drive

SCHEMA = schema(track("driving"))
TARGET = {"objective": "target", "target_action": 3, "target_acceleration": 1.0, "target_steering": 0.5}


def report(*tables: pa.Table, width: int = 120) -> str:
    out = io.StringIO()
    thesis_report({"driving": pa.concat_tables(tables)} if tables else {}, Console(file=out, width=width))
    return out.getvalue()


def attacked(victim: str = "dqn", **changes: object) -> pa.Table:
    settings = {
        "attack": "zo",
        "attack_params": TARGET,
        "threat": ("linf", 0.2),
        "skill": 0.2,
        "cells": CLEAR,
        **changes,
    }
    return drive(victim, **settings)  # type: ignore[arg-type]


def skip_sweep(clean: dict[float, float], under_attack: dict[float, float], runs: int = 4) -> Iterator[pa.Table]:
    for skip in clean:
        defended = {"defense": "advtrain", "defense_params": {"skip": skip}, "cells": CLEAR[:1], "runs": range(runs)}
        yield drive(skill=clean[skip], **defended)  # type: ignore[arg-type]
        yield attacked(**{**defended, "skill": under_attack[skip]})


def numbers_in(node: object) -> Iterator[float]:
    if isinstance(node, dict):
        for name, value in node.items():
            if name not in ("printed_percent", "lanes", "density", "skip", "max_reward"):
                yield from numbers_in(value)
    elif isinstance(node, list):
        for value in node:
            yield from numbers_in(value)
    elif isinstance(node, float):
        yield node


def test_every_printed_number_stands_in_the_report() -> None:
    text, numbers = report().split("Chapter 4")[1], printed()
    found = list(numbers_in([numbers[name] for name in ("skip", "policies", "generalisation")]))
    assert len(found) == 6 + 8 + 12
    for number in found:
        assert f"{number:.2f}" in text


def test_a_missing_number_is_a_dash_and_a_command_that_the_command_line_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(policy_records, "published", lambda track: schema(track).empty_table())
    text = report()
    commands = re.findall(r"missing: (bench run .*)", text.split("Chapter 4")[1])
    assert "—" in text
    assert len(commands) >= 4
    for command in commands:
        config = plan_of(command.removeprefix("bench run ").split())
        assert all(
            pair.threat.budget == 0.2 and pair.threat.norm == "linf" for pair in config.pairs if not pair.is_clean
        )
        assert config.grid.values["weather"] == ("clear",)


@pytest.mark.parametrize(
    "other",
    [
        attacked(threat=("relative", 0.2)),
        attacked(threat=("linf", 0.1)),
        attacked(attack_params={**TARGET, "objective": "expected"}),
        attacked(attack_params={**TARGET, "target_action": 4}),
        attacked(defense="advtrain", defense_params={"skip": 0.3}),
        attacked("ddpg"),
        attacked(cells=[cell for cell in CLEAR if cell.lanes != 3]),
    ],
)
def test_records_of_other_settings_do_not_stand_beside_the_thesis(other: pa.Table) -> None:
    assert Source(other, SCHEMA.empty_table()).find(Wanted("dqn", "zo")) is None
    found = Source(attacked(), SCHEMA.empty_table()).find(Wanted("dqn", "zo"))
    assert found is not None
    assert found.episodes.cells == CLEAR[:1]


def test_our_numbers_stand_beside_the_thesis() -> None:
    found = Source(attacked("ddpg"), SCHEMA.empty_table()).find(Wanted("ddpg", "zo"))
    assert found is not None
    table_2 = (
        report(attacked("ddpg"), drive("ddpg", cells=CLEAR), baseline_drivers()).split("Table 4.2")[1].split("Table")[0]
    )
    (row,) = (line for line in table_2.splitlines() if line.strip().startswith("under attack"))
    assert "108.22" in row
    assert "45.44" in row
    assert f"{found.episode_return.estimate:.0f} " in row


def test_published_records_fill_what_the_user_has_not_and_are_marked() -> None:
    mine, shipped = drive(cells=CLEAR), pa.concat_tables([drive(cells=CLEAR, skill=0.1), attacked()])
    source = Source(mine, shipped)
    clean, under_attack = source.find(Wanted("dqn")), source.find(Wanted("dqn", "zo"))
    assert clean is not None
    assert under_attack is not None
    assert (clean.shipped, under_attack.shipped) == (False, True)


@pytest.mark.parametrize("own", [one for one in tracks() if one.name in ("driving", "detection")])
def test_published_records_have_the_schema_of_records(own: Track) -> None:
    assert published(own).num_rows
    assert published(own).schema.equals(schema(own))


@pytest.mark.parametrize(
    ("name", "recorded", "score"),
    [("driving", drive(cells=CLEAR), "safe_progress"), ("detection", approach(0.9), "confidence_mean")],
)
def test_what_is_published_is_what_was_recorded(tmp_path: Path, name: str, recorded: pa.Table, score: str) -> None:
    results.prepare(tmp_path)
    results.write(tmp_path, recorded)
    assert publish(tmp_path, tmp_path / "published.parquet") == recorded.num_rows
    shipped = pq.read_table(tmp_path / "published.parquet")
    assert shipped.schema.equals(schema(track(name)))
    assert sorted(shipped[score].to_pylist()) == sorted(recorded[score].to_pylist())


def test_times_are_published_with_three_digits() -> None:
    times = {"wall_s": [1.23456, None], "attack_ms": [1234.5, 0.0], "safe_progress": [0.123456, 1.0]}
    assert rounded(pa.table(times)).to_pydict() == {
        "wall_s": [1.23, None],
        "attack_ms": [1230.0, 0.0],
        "safe_progress": [0.123456, 1.0],
    }


def test_perturbations_are_published_in_single_precision_and_scores_as_they_are() -> None:
    exact = {"l2": [1 / 3, None], "safe_progress": [1 / 3, 1.0]}
    assert rounded(pa.table(exact)).to_pydict() == {
        "l2": [float(np.float32(1 / 3)), None],
        "safe_progress": [1 / 3, 1.0],
    }


def scores_of(records: pa.Table, run: int) -> list[float]:
    """The scores of a training seed, sorted."""
    return sorted(records["safe_progress"].filter(pc.equal(records["training_seed"], run)).to_pylist())


def test_added_records_renew_a_training_seed_and_leave_the_others(tmp_path: Path) -> None:
    """A folder with fewer episodes of a pair and seed than the file renews nothing of it."""
    file = tmp_path / "published.parquet"
    first = drive(cells=CLEAR, skill=0.3)
    again, few = drive(cells=CLEAR, runs=(1,), skill=0.9), drive(cells=CLEAR[:1], runs=(2,), skill=0.8)
    for number, records in enumerate((first, again, few)):
        folder = tmp_path / str(number)
        results.prepare(folder)
        results.write(folder, records)
        assert publish(folder, file, add=number > 0) == first.num_rows
    shipped = pq.read_table(file)
    assert [scores_of(shipped, run) for run in (0, 1, 2)] == [
        scores_of(first, 0),
        scores_of(again, 1),
        scores_of(first, 2),
    ]
    assert scores_of(again, 1) != scores_of(first, 1)


def test_records_of_another_track_are_not_added(tmp_path: Path) -> None:
    file = tmp_path / "published.parquet"
    for number, records in enumerate((drive(cells=CLEAR[:1]), approach(0.9))):
        folder = tmp_path / str(number)
        results.prepare(folder)
        results.write(folder, records)
        if number == 0:
            publish(folder, file)
    with pytest.raises(UserError, match="has others"):
        publish(folder, file, add=True)


def test_records_of_two_tracks_are_not_published_as_one_file(tmp_path: Path) -> None:
    results.prepare(tmp_path)
    for unit, several in enumerate((drive(cells=CLEAR[:1]), approach(0.9))):
        records = several.slice(0, 1)  # A unit has each episode once.
        named = pa.array([str(unit) * 64] * records.num_rows)
        results.write(tmp_path, records.set_column(0, records.schema.field(0), named))
    with pytest.raises(UserError, match="detection and driving"):
        publish(tmp_path, tmp_path / "published.parquet")


def test_the_report_reads_published_records(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(policy_records, "published", lambda track: drive(cells=CLEAR))
    assert "†" in report().split("Table 4.2")[1]


@pytest.fixture
def nothing_published(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(policy_records, "published", lambda track: schema(track).empty_table())


@pytest.mark.usefixtures("nothing_published")
def test_a_trade_off_over_seeds_is_found() -> None:
    text = report(*skip_sweep({0.0: 0.2, 0.3: 0.4, 0.5: 0.6, 1.0: 0.9}, {0.0: 0.6, 0.3: 0.45, 0.5: 0.3, 1.0: 0.1}))
    assert "DQN: does the trade-off exist? Yes." in text
    assert "DDPG: does the trade-off exist? It cannot be said" in text


@pytest.mark.usefixtures("nothing_published")
def test_no_trade_off_is_claimed_from_noise_or_from_two_seeds() -> None:
    same = {0.0: 0.5, 0.3: 0.5, 0.5: 0.5, 1.0: 0.5}
    assert "does the trade-off exist? Not shown." in report(*skip_sweep(same, same))
    rising, falling = {0.0: 0.2, 0.3: 0.4, 0.5: 0.6, 1.0: 0.9}, {0.0: 0.6, 0.3: 0.45, 0.5: 0.3, 1.0: 0.1}
    assert "cannot be said" in report(*skip_sweep(rising, falling, runs=2)).split("DDPG: does")[0]
    assert "No, the opposite." in report(*skip_sweep(falling, rising))


@given(arrays(np.float64, st.tuples(st.integers(3, 6), st.integers(3, 5)), elements=st.floats(0, 450, width=32)))
@settings(max_examples=40, deadline=None)
def test_a_trend_turns_round_with_the_order_of_the_settings(scores: np.ndarray) -> None:
    forward, backward = trend(scores), trend(scores[:, ::-1])
    turned = {"rises": "falls", "falls": "rises"}
    assert backward.direction == turned.get(forward.direction, forward.direction)
    assert backward.correlation == pytest.approx(-forward.correlation)


def test_a_trend_needs_seeds_and_settings() -> None:
    with pytest.raises(ValueError, match="two training seeds"):
        trend(np.zeros((1, 4)))


@pytest.mark.parametrize("width", [100, 120])
def test_no_number_is_cut_off(width: int) -> None:
    text = report(attacked("ddpg"), drive("ddpg", cells=CLEAR), attacked(), drive(cells=CLEAR), width=width)
    lines = [line for line in text.splitlines() if "missing:" not in line]
    assert max(map(len, lines)) <= width
    # An interval of numbers below 0 is written −.54…−.53.
    assert not re.search(r"…(?![−+.\d])", text)
