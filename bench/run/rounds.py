"""`until=`: drives scenarios in rounds, and stops a row when its score is known closely enough or its grid is done.

A row is an attack on a defended victim. Rows of the same defended victim go on together, so that the strongest attack is chosen
among attacks on the same scenarios; one that cannot be the strongest any more in any cell is ruled out and drives no more rounds.

All that is decided follows from records: a run that was killed decides the same when it is resumed.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cavbench.core.pair import Pair
from cavbench.core.track import track_of
from cavbench.run import stops
from cavbench.run.networks import Weights
from cavbench.run.plan import Plan
from cavbench.run.results import Results
from cavbench.run.stops import Stop
from cavbench.run.unit import Unit
from cavbench.statistics.episodes import Episodes
from cavbench.statistics.estimates import CONFIDENCE, Array
from cavbench.statistics.sequential import confidence_sequence, shown_higher

Drive = Callable[[Sequence[Unit]], Collection[str]]
"""Drives units, and returns the fingerprints of those that are finished."""


@dataclass(eq=False)
class Row:
    """A pair with its scores so far.

    Args:
        pair: the pair.
        until: half the width of the interval at which it has enough scenarios.
        most: scenarios of the grid in each cell.
        parts: [R, C, n] of each round: runs, cells, scenarios.
        stop: where it stopped; None while it goes on.
    """

    pair: Pair
    until: float
    most: int
    parts: list[Array] = field(default_factory=list)
    stop: Stop | None = None

    @property
    def scores(self) -> Array:
        """[R, C, n] of all rounds."""
        return np.concatenate(self.parts, -1)

    def stopped(self, why: str, by: tuple[str, ...] = ()) -> Stop:
        """Where it would stop now."""
        if not self.parts:
            bounds, scenarios = (0.5, 0.0, 1.0), 0
        else:
            means = self.scores.mean((0, 1))
            low, high = confidence_sequence(means, width=self.until, most=self.most)
            bounds, scenarios = (float(means.mean()), float(low[-1]), float(high[-1])), len(means)
        estimate, lowest, highest = bounds
        return Stop(
            pair=self.pair.id,
            why=why,
            by=by,
            until=self.until,
            scenarios=scenarios,
            most=self.most,
            estimate=estimate,
            low=lowest,
            high=highest,
        )


def drive_until(plan: Plan, weights: Weights, drive: Drive, results: Results) -> list[str]:
    """Drive round after round until every row has stopped. Write where each stopped, and return the fingerprints of all units.

    Args:
        plan: the run, with `until`.
        weights: of its networks.
        drive: carries out units.
        results: the results folder.
    """
    assert plan.until is not None
    groups: dict[object, list[Row]] = {}
    for pair in plan.pairs:
        groups.setdefault(_defended(pair), []).append(Row(pair, plan.until, plan.grid.episodes))
    every = [row for rows in groups.values() for row in rows]
    units: list[str] = []
    for part in plan.rounds:
        going = [row for row in every if row.stop is None]
        if not going:
            break
        own = replace(part, pairs=tuple(row.pair for row in going)).units(weights)
        finished = drive(own)
        units += [unit.fingerprint for unit in own]
        _add(going, own, finished, results)
        for rows in groups.values():
            look(rows)
    for row in every:
        stops.write(results.folder, row.stop or row.stopped("grid done"))
    return units


def _defended(pair: Pair) -> object:
    parts = (pair.defense, pair.victim, pair.world)
    return *((part.name, part.params) for part in parts), tuple(sorted(pair.threat.columns.items()))


def _add(going: Sequence[Row], own: Sequence[Unit], finished: Collection[str], results: Results) -> None:
    """Add the scores of a round; a pair of which a unit failed has stopped."""
    lost = {unit.pair.id for unit in own if unit.fingerprint not in finished}
    scored = {row.pair.id for row in going} - lost
    keys = [unit.fingerprint for unit in own if unit.pair.id in scored]
    track = track_of(going[0].pair)
    records = results.records(keys, track) if keys else pa.table({"pair": pa.array([], pa.string())})
    for row in going:
        if row.pair.id in lost or not any(unit.pair.id == row.pair.id for unit in own):
            row.stop = row.stopped("failed")
        else:
            episodes = Episodes.arrange(records.filter(pc.equal(records["pair"], row.pair.id)))
            row.parts.append(episodes.column(track.metric))


def look(rows: Sequence[Row]) -> None:
    """Stop rows of a defended victim that cannot be the strongest any more, and all if the others are known closely enough."""
    going = [row for row in rows if row.stop is None]
    if not going:
        return
    if len(rows) > 1:
        _rule_out(rows, going)
        going = [row for row in rows if row.stop is None]
    found = [row.stopped("narrow") for row in going]
    if all(stop.high - stop.low <= 2 * row.until for stop, row in zip(found, going, strict=True)):
        for row, stop in zip(going, found, strict=True):
            row.stop = stop


def _rule_out(rows: Sequence[Row], going: Sequence[Row]) -> None:
    """Stop each row that another one beats in every cell. All of this errs for a strongest attack with probability 5 % at most.

    In each cell the differences of scores on the same scenarios, mean over training seeds, are tested one by one (Bonferroni
    over cells and rivals).
    """
    scores = np.stack([row.scores.mean(0) for row in going])
    _, cells, _ = scores.shape
    tail = (1 - CONFIDENCE) / (cells * (len(rows) - 1))
    higher = shown_higher((1 + scores[:, None] - scores[None]) / 2, tail)
    weaker = np.asarray(higher.any(1).all(-1))
    # A contradiction, which chance allows: nothing is known.
    if weaker.all():
        return
    for row, beaten, lost in zip(going, higher, weaker, strict=True):
        if lost:
            rivals = [going[place].pair.id for place in dict.fromkeys(beaten.argmax(0).tolist())]
            row.stop = row.stopped("ruled out", by=tuple(rivals))
