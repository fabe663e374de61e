"""Chapter 4 of the thesis beside ours, and what is published."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from rich.console import Console

from cavbench.core.track import track
from cavbench.leaderboard.thesis import policy_records
from cavbench.leaderboard.thesis.numbers import printed
from cavbench.leaderboard.thesis.policy_records import Source, Wanted
from cavbench.leaderboard.thesis.report import thesis_report
from cavbench.leaderboard.thesis.trend import trend
from cavbench.records.schema import schema
from cavbench.run.config import plan_of
from tests.leaderboard.synthetic import CLEAR, baseline_drivers, drive

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
    monkeypatch.setattr(policy_records, "shipped_records", lambda chapter: schema(track("driving")).empty_table())
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


def test_the_report_reads_published_records(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(policy_records, "shipped_records", lambda chapter: drive(cells=CLEAR))
    assert "†" in report().split("Table 4.2")[1]


@pytest.fixture
def nothing_published(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(policy_records, "shipped_records", lambda chapter: schema(track("driving")).empty_table())


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
