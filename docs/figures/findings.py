"""Findings of docs/results.md, from the published records: what more attacks, filters, faults, trainings and patches change."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cavbench.core.track import track
from cavbench.leaderboard.published import published
from cavbench.leaderboard.ranking.boards import Row, read_boards
from cavbench.statistics.estimates import Interval
from docs.figures import style
from docs.figures.leaderboard import plain_name, point

GRIDS = {"driving": "standard-v2", "detection": "approach-v1"}
GROWING = (("noise",), ("noise", "zo"), ("noise", "zo", "pgd"), ("noise", "zo", "pgd", "plan"), ())
"""Sets of attacks, each with one more. The last one is all."""


def attacks() -> Figure:
    """The same driver under more and more attacks."""
    records = _of("driving")
    records = records.filter(_is(records, "dqn", "advtrain"))
    driven = pc.unique(records["attack"]).to_pylist()
    assert set(GROWING[-2]) <= set(driven)
    points = {}
    for names in GROWING:
        kept = ["none", *names] if names else driven
        row = _rows("driving", records.filter(pc.is_in(records["attack"], pa.array(kept))))[0]
        points[f"+ {names[-1]}" if names[1:] else (names[0] if names else "whole suite")] = row.worst.score
    made = style.figure(2.5, "What is left of dqn + advtrain under more attacks")
    axes = made.subplots()
    _dots(axes, [(name, {style.SHOWN: score}) for name, score in points.items()])
    axes.set(xlim=(0, 1), xlabel="safe progress under the strongest of them")
    return made


def filters() -> Figure:
    """Networks alone and behind filters."""
    rows = {plain_name(row): row for row in _rows("driving", _of("driving"))}
    names = [one + behind for one in ("dqn", "ppo", "sac") for behind in ("", " + tracker+shield")]
    made = style.figure(2.9, "The filter matters more than the network")
    axes = made.subplots()
    _dots(axes, [(name, _both(rows[name])) for name in [*names, "planner", "planner + tracker"]])
    axes.set(xlim=(0, 1), xlabel="safe progress")
    _legend(made, {"no attack": style.TRUE, "strongest attack": style.SHOWN})
    return made


def faults() -> Figure:
    """Crashes of five drivers under attacks on the whole grid, and under faults on one road."""
    rows = {plain_name(row): row for row in _rows("driving", published(track("driving")))}
    lines = []
    for name in ("planner + tracker", "dqn + tracker+shield", "planner", "dqn + shield", "dqn + advtrain"):
        row = rows[name]
        assert row.faults is not None
        crashed = {style.SHOWN: float(row.worst.failed.mean()), style.FAULT: row.faults.crashed}
        lines.append((name, {colour: Interval(share, share, share) for colour, share in crashed.items()}))
    made = style.figure(2.5, "Who withstands lies may fail under faults")
    axes = made.subplots()
    _dots(axes, lines)
    axes.set(xlim=(0, 1), xlabel="share of episodes with a crash")
    _legend(made, {"strongest attack": style.SHOWN, "mean of the faults": style.FAULT})
    return made


def trainings() -> Figure:
    """The ten trainings of four drivers, each under the strongest attack."""
    rows = {plain_name(row): row for row in _rows("driving", _of("driving"))}
    made = style.figure(2.2, "Ten trainings of one recipe")
    axes = made.subplots()
    names = ["dqn", "ddpg", "dqn + advtrain", "dqn + tracker+shield"]
    for place, name in enumerate(names):
        scores = rows[name].worst.scores.mean((1, 2))
        axes.plot(scores, np.full(len(scores), place), "o", color=style.SHOWN, ms=7, alpha=0.5, mec="none")
    _named(axes, names)
    axes.set(xlim=(0, 1), xlabel="safe progress under the strongest attack")
    return made


def detectors() -> Figure:
    """Four detectors, alone and hardened."""
    rows = {plain_name(row): row for row in _rows("detection", _of("detection"))}
    names = [one for one in rows if "+" not in one or one.endswith("advtrain")]
    made = style.figure(2.9, "Adversarial training holds")
    axes = made.subplots()
    _dots(axes, [(name, _both(rows[name])) for name in sorted(names)])
    axes.set(xlim=(0, 1), xlabel="stop score")
    _legend(made, {"no patch": style.TRUE, "strongest patch": style.SHOWN})
    return made


def patches() -> Figure:
    """What one detector keeps under each attack alone, without a defence and hardened."""
    rows = {plain_name(row): row for row in _rows("detection", _of("detection"))}
    kept: dict[str, dict[str, Interval]] = {}
    for colour, row in (
        (style.UNDEFENDED, rows["yolov3_tiny"]),
        (style.HARDENED, rows["yolov3_tiny + advtrain"]),
    ):
        for one in row.attacks:
            points = kept.setdefault(str(one.identity["attack"]), {})
            points[colour] = min(points.get(colour, one.score), one.score, key=lambda found: found.estimate)
    made = style.figure(2.6, "What each patch leaves of yolov3_tiny")
    axes = made.subplots()
    _dots(axes, sorted(kept.items(), key=lambda item: -item[1][style.HARDENED].estimate))
    axes.set(xlim=(0, 1), xlabel="stop score")
    _legend(made, {"undefended": style.UNDEFENDED, "hardened": style.HARDENED})
    return made


def _dots(axes: Axes, lines: Sequence[tuple[str, Mapping[str, Interval]]]) -> None:
    """A line for each name, with points of a colour and their intervals."""
    for place, (_, points) in enumerate(lines):
        for colour, found in points.items():
            point(axes, found, place, colour)
    _named(axes, [name for name, _ in lines])


def _named(axes: Axes, names: Sequence[str]) -> None:
    axes.set(yticks=range(len(names)), yticklabels=names, ylim=(len(names) - 0.5, -0.5))
    axes.spines["left"].set_visible(False)
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="x", color=style.FAINT, lw=0.6)
    axes.set_axisbelow(True)


def _legend(made: Figure, colours: Mapping[str, str]) -> None:
    handles = [Line2D([], [], marker="o", ls="", ms=7, color=colour) for colour in colours.values()]
    made.legend(handles, list(colours), loc="outside lower center", ncols=2, handletextpad=0.1)


def _of(name: str) -> pa.Table:
    records = published(track(name))
    return records.filter(pc.equal(records["grid"], GRIDS[name]))


def _is(records: pa.Table, victim: str, defense: str) -> pa.Array:
    return pc.and_(pc.equal(records["victim"], victim), pc.equal(records["defense"], defense))


def _rows(name: str, records: pa.Table) -> Sequence[Row]:
    boards, _ = read_boards({name: records})
    return max(boards, key=lambda board: len(board.rows)).rows


def _both(row: Row) -> dict[str, Interval]:
    assert row.worst.clean is not None
    return {style.TRUE: row.worst.clean, style.SHOWN: row.worst.score}
