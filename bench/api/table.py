"""The scores of a run as a DataFrame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from cavbench.api import export
from cavbench.core.pair import Pair
from cavbench.core.track import Track
from cavbench.run.plan import Plan
from cavbench.scenarios import Cell
from cavbench.statistics import doubts
from cavbench.statistics.doubts import Remark
from cavbench.statistics.episodes import Episodes
from cavbench.statistics.estimates import Array, Interval, share_interval
from cavbench.statistics.strongest import strongest_of, under

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STRONGEST = "strongest"
"""Name of the row in which the strongest attack of each cell counts."""


NOT_PRINTED = ("worst_cell", "worst_score", "queries", "episodes", "pair")
"""Columns that `print(scores)` leaves out, besides the intervals of the failure rate."""


NOT_SAID = ("one_training",)
"""Remarks that `print(scores)` leaves out: they make no number wrong."""


class Scores(pd.DataFrame):
    """A DataFrame of scores; a part of it, such as `scores[scores.role == "attacked"]`, is a plain DataFrame."""

    _metadata = ["_episodes", "_remarks"]  # noqa: RUF012 - pandas reads a list
    _remarks: tuple[Remark, ...] = ()

    def __repr__(self) -> str:
        """The main columns as text, rounded, and the remarks; pandas would cut out the columns in the middle: the scores."""
        told = [name for name in self.columns if name not in NOT_PRINTED and not name.endswith(("_low", "_high"))]
        if "defense" in told and self["defense"].nunique() < 2:
            told.remove("defense")
        shown = str(pd.DataFrame(self)[told].to_string(index=False, float_format="%.2f", na_rep=""))
        return "\n".join([shown, *(f"! {remark}" for remark in self.remarks if remark.name not in NOT_SAID)])

    def _repr_html_(self) -> str:
        """The table of a notebook, with the remarks below."""
        shown = str(pd.DataFrame(self)._repr_html_())
        return shown + "".join(f"<p>⚠ {escape(str(one))}</p>" for one in self.remarks if one.name not in NOT_SAID)

    def to_latex(self, *given: Any, **options: Any) -> str:
        """The main columns for LaTeX (booktabs), scores with their intervals; with arguments, what pandas makes of them."""
        return str(super().to_latex(*given, **options)) if given or options else export.latex(self)

    def plot(self, kind: export.Plot = "matrix", *others: Scores, axes: Axes | None = None) -> Axes:
        """A plot, for which matplotlib must be installed: `pip install 'cavbench[plot]'`.

        Args:
            kind: `matrix`, attack by defence; `cells`, a heat map under the strongest attack, for `score(..., by="cell")`; or
                `budget`, scores against the budget.
            others: for `budget`, the scores under other budgets.
            axes: matplotlib's axes to draw on; by default new ones.

        Raises:
            UserError: if matplotlib is not installed, or the scores do not have what the plot shows.
        """
        return export.plot(self, kind, others, axes)

    @property
    def remarks(self) -> list[Remark]:
        """What a reader must know before trusting the numbers, each with `name`, `about` and `text`."""
        return list(self._remarks)

    @property
    def records(self) -> pd.DataFrame:
        """The records that the scores are computed from, one row an episode (columns: `cavbench.records.schema`)."""
        return self._episodes.to_pandas()


@dataclass(frozen=True)
class _Row:
    """A row before it is aggregated.

    Args:
        role: strongest, attacked, clean or baseline.
        pair: the pair; of the strongest attack, one of the pairs that it is chosen from.
        attack: text of the attack.
        cells: [C].
        scores: [R, C, E] of the ranking metric.
        failed: [R, C, E] whether the episode failed; None if the track has no failure.
        queries: mean number of queries of the attack; NaN for none.
        clean: [R, C, E] of the same victim without an attack; None for baselines and the clean control itself.
        table: the records; None for the strongest attack.
    """

    role: str
    pair: Pair
    attack: str
    cells: tuple[Cell, ...]
    scores: Array
    failed: Array | None
    queries: float = np.nan
    clean: Array | None = None
    table: pa.Table | None = None


def scores_of(plan: Plan, records: pa.Table, by: str = "pair") -> Scores:
    """One row for each pair, or for each pair and cell, the strongest attack first.

    Columns: `role` (`strongest`: in each cell the attack counts that is the strongest on other scenarios; `attacked`, `clean`,
    `baseline`), `attack`, `defense`, `victim`, the axes if by cell, the ranking metric of the track (`safe_progress` for drivers)
    with its 95 % interval `low` and `high`, the rate of the track's failure (`crashed`) with its interval, `kept` (attacked /
    clean score), `worst_cell` and `worst_score` if by pair, `queries` of the attack, `episodes`, and `pair`, its name in records.

    Args:
        plan: the run.
        records: its records, clean controls and baselines among them.
        by: `pair` or `cell`.
    """
    track = plan.track
    rows = list(_rows(plan, records, track))
    table = Scores([line for row in rows for line in _lines(row, track, by)])
    table._episodes = records
    table._remarks = tuple(dict.fromkeys(_said_against(rows, track)))
    return table


def _rows(plan: Plan, records: pa.Table, track: Track) -> Iterator[_Row]:
    groups: dict[str, list[Pair]] = {}
    for pair in plan.pairs:
        groups.setdefault(pair.clean().id, []).append(pair)
    for pairs in sorted(groups.values(), key=lambda pairs: _place(pairs[0])):
        control = pairs[0].clean()
        clean = _episodes(records, control)
        attacked = []
        for pair in (pair for pair in pairs if not pair.is_clean):
            own = _episodes(records, pair)
            # A run of an attack that has training seeds of its own is paired with the only one of the victim.
            beside = _like(clean, own.shape, track.metric)
            attacked.append(
                _Row("attacked", pair, str(pair.attack), own.cells, own.column(track.metric), _failed(own, track),
                     _queries(own, track), beside, own.table)
            )  # fmt: skip
        attacked.sort(key=lambda row: (round(float(row.scores.mean()), 9), row.attack, row.pair.id))
        if len(attacked) > 1:
            yield _strongest(attacked)
        yield from attacked
        yield _Row(
            "clean", control, "none", clean.cells, clean.column(track.metric), _failed(clean, track), table=clean.table
        )
    baselines = []
    for pair in plan.baselines:
        own = _episodes(records, pair)
        baselines.append(
            _Row(
                "baseline",
                pair,
                str(pair.attack),
                own.cells,
                own.column(track.metric),
                _failed(own, track),
                table=own.table,
            )
        )
    yield from sorted(baselines, key=lambda row: (-round(float(row.scores.mean()), 9), row.pair.id))


def _place(pair: Pair) -> tuple[object, ...]:
    """Where a defended victim stands: by victim, then without a defence first; the order of the arguments changes nothing."""
    return str(pair.victim), pair.defense.name != "none", str(pair.defense), pair.id


def _said_against(rows: Sequence[_Row], track: Track) -> Iterator[Remark]:
    """What stands under the table: of each row, and of the baselines together."""
    clean = {row.pair.id: row for row in rows if row.role == "clean"}
    members: dict[str, dict[str, float]] = {}
    for row in rows:
        control = clean.get(row.pair.clean().id)
        victim = _victim(row.pair)
        if row.role == "attacked" and control:
            members.setdefault(row.pair.clean().id, {})[row.attack] = float(row.scores.mean())
            found = doubts.remarks(row.table, control.table, track, f"{row.attack} on {victim}")
            yield from (one for one in found if one.name not in doubts.OF_VICTIM)
        elif row.role == "clean":
            yield from doubts.remarks(None, row.table, track, victim)
            weights = row.table is not None and bool(set(row.table["weights_sha256"].unique().to_pylist()) - {""})
            yield from doubts.of_runs(len(row.scores), track, victim, trained=weights or track.artefact is not None)
    for row in rows:
        if row.role == STRONGEST:
            yield from doubts.above_members(
                float(row.scores.mean()), members[row.pair.clean().id], f"{row.attack} on {_victim(row.pair)}"
            )
    baselines = [row.table for row in rows if row.role == "baseline" and row.table is not None]
    yield from doubts.of_baselines(baselines, track)


def _victim(pair: Pair) -> str:
    return f"{pair.victim} + {pair.defense}" if pair.defense.name != "none" else str(pair.victim)


def _strongest(rows: list[_Row]) -> _Row:
    """The row of the strongest attack of each cell; attacks without training seeds count in every run."""
    runs = max(len(row.scores) for row in rows)
    shape = (runs, *rows[0].scores.shape[1:])
    scores = np.stack([np.broadcast_to(row.scores, shape) for row in rows])
    weights = strongest_of(scores)
    failed = None
    if rows[0].failed is not None:
        failed = under(weights, np.stack([np.broadcast_to(np.asarray(row.failed, float), shape) for row in rows]))
    clean = None if rows[0].clean is None else np.broadcast_to(rows[0].clean, shape)
    text = f"{STRONGEST} of {len(rows)}"
    return _Row(STRONGEST, rows[0].pair, text, rows[0].cells, under(weights, scores), failed, np.nan, clean)


def _episodes(records: pa.Table, pair: Pair) -> Episodes:
    return Episodes.arrange(records.filter(pc.equal(records["pair"], pair.id)))


def _like(clean: Episodes, shape: tuple[int, int, int], metric: str) -> Array:
    """The clean scores [R, C, E], repeated for the runs of an attack."""
    return np.broadcast_to(clean.column(metric), shape) if len(clean.runs) == 1 else clean.column(metric)


def _failed(episodes: Episodes, track: Track) -> Array | None:
    return episodes.column(track.failure) if track.failure else None


def _queries(episodes: Episodes, track: Track) -> float:
    return float(np.nanmean(episodes.column(track.queries)))


def _lines(row: _Row, track: Track, by: str) -> Iterator[dict[str, Any]]:
    names = {
        "role": row.role,
        "attack": row.attack,
        "defense": str(row.pair.defense),
        "victim": str(row.pair.victim),
    }
    if by == "cell":
        for place, cell in enumerate(row.cells):
            yield names | dict(cell) | _aggregated(row, track, [place]) | _last(row)
        return
    means = row.scores.mean((0, 2)).round(9)
    worst = {"worst_cell": str(row.cells[int(means.argmin())]), "worst_score": float(means.min())}
    yield names | _aggregated(row, track, list(range(len(row.cells)))) | worst | _last(row)


def _aggregated(row: _Row, track: Track, places: list[int]) -> dict[str, Any]:
    scores = row.scores[:, places]
    found = _columns(track.metric, "", share_interval(scores))
    if row.failed is not None:
        found |= _columns(track.failure, f"{track.failure}_", share_interval(row.failed[:, places]))
    before = float(row.clean[:, places].mean()) if row.clean is not None else 0.0
    return found | {"kept": float(scores.mean()) / before if before > 0 else np.nan, "episodes": int(scores.size)}


def _columns(name: str, prefix: str, found: Interval) -> dict[str, float]:
    return {name: found.estimate, f"{prefix}low": found.low, f"{prefix}high": found.high}


def _last(row: _Row) -> dict[str, Any]:
    return {"queries": row.queries, "pair": "" if row.role == STRONGEST else row.pair.id}
