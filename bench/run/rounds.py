"""`until=`: drives scenarios in rounds, and stops a row when its score is known closely enough or its grid is done.

A row is an attack on a defended victim. Rows of the same defended victim go on together, so that the strongest attack is chosen
among attacks on the same scenarios; one that cannot be the strongest any more in any cell is ruled out and drives no more rounds.

All that is decided follows from records: a run that was killed decides the same when it is resumed.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cavbench import bounded, files
from cavbench.core.pair import Pair
from cavbench.core.track import track_of
from cavbench.errors import UserError
from cavbench.records import reading
from cavbench.records.schema import SEQUENTIAL
from cavbench.run.config import RunConfig
from cavbench.run.plan import Weights, units_of
from cavbench.run.unit import Unit
from cavbench.statistics.episodes import Episodes
from cavbench.statistics.estimates import CONFIDENCE, Array
from cavbench.statistics.sequential import confidence_sequence, shown_higher

SCENARIOS = 10
"""Scenarios of each cell in a round."""
FOLDER = "stops"
Drive = Callable[[Sequence[Unit]], Collection[str]]
"""Drives units, and returns the fingerprints of those that are finished."""


@dataclass(frozen=True)
class Stop:
    """Where a row stopped, and what was known then.

    Args:
        pair: name of the pair.
        why: `narrow`, `ruled out`, `grid done` or `failed`.
        by: for a pair that was ruled out, the pairs that were stronger in its cells.
        until: half the width of the interval that was asked for.
        scenarios: scenarios driven in each cell.
        most: scenarios of the grid in each cell.
        estimate: mean of the ranking metric over training seeds, cells and scenarios.
        low, high: bounds of the mean over all scenarios, for these trained victims; valid at every look together with 95 %.
    """

    pair: str
    why: str
    by: tuple[str, ...]
    until: float
    scenarios: int
    most: int
    estimate: float
    low: float
    high: float

    def __str__(self) -> str:
        said = {"narrow": "known closely enough", "ruled out": f"ruled out by {' and '.join(self.by)}"}
        return (
            f"{self.pair}: {self.estimate:.3f} ({self.low:.3f} to {self.high:.3f}) after {self.scenarios} of {self.most} "
            f"scenarios a cell, {said.get(self.why, self.why)}"
        )


@dataclass(eq=False)
class _Row:
    """A pair with its scores so far."""

    pair: Pair
    parts: list[Array] = field(default_factory=list)
    stop: Stop | None = None

    @property
    def scores(self) -> Array:
        """[R, C, n]: runs, cells, scenarios."""
        return np.concatenate(self.parts, -1)


def rounds(config: RunConfig) -> list[RunConfig]:
    """The rounds of a run; the run itself if it has no `until`."""
    if config.until is None:
        return [config]
    grid = config.grid
    first = range(0, grid.episodes, SCENARIOS)
    parts = [(grid.first_seed + start, min(SCENARIOS, grid.episodes - start)) for start in first]
    grids = [replace(grid, name=SEQUENTIAL, first_seed=seed, episodes=count) for seed, count in parts]
    return [replace(config, grid=part) for part in grids]


def drive_until(config: RunConfig, weights: Weights, drive: Drive) -> list[str]:
    """Drive round after round until every row has stopped. Write where each stopped, and return the fingerprints of all units.

    Args:
        config: the run, with `until`.
        weights: of its networks (`cavbench.run.plan.units_of`).
        drive: carries out units.
    """
    groups: dict[object, list[_Row]] = {}
    for pair in config.pairs:
        groups.setdefault(_defended(pair), []).append(_Row(pair))
    units: list[str] = []
    for part in rounds(config):
        going = [row for rows in groups.values() for row in rows if row.stop is None]
        if not going:
            break
        own = units_of(replace(part, pairs=tuple(row.pair for row in going)), weights)
        finished = drive(own)
        units += [unit.fingerprint for unit in own]
        _add(config, going, own, finished)
        for rows in groups.values():
            _look(config, rows)
    for rows in groups.values():
        for row in rows:
            row.stop = row.stop or _stop(config, row, "grid done")
            _write(config.out, row.stop)
    return units


def read(out: Path, pairs: Iterable[str]) -> list[Stop]:
    """Where the rows of some pairs stopped; pairs without `until` have none."""
    found = []
    for pair in pairs:
        path = out / FOLDER / f"{pair}.json"
        if path.exists():
            try:
                content = bounded.read_json(path, finite=False)
                found.append(Stop(**content | {"by": tuple(content["by"])}))
            except (UserError, ValueError, TypeError, KeyError):
                raise UserError(f"{path} cannot be read; run the same command again to recreate it") from None
    return found


def _defended(pair: Pair) -> object:
    parts = (pair.defense, pair.victim, pair.world)
    return *((part.name, part.params) for part in parts), tuple(sorted(pair.threat.columns.items()))


def _add(config: RunConfig, going: Sequence[_Row], own: Sequence[Unit], finished: Collection[str]) -> None:
    """Add the scores of a round; a pair of which a unit failed has stopped."""
    lost = {unit.pair.id for unit in own if unit.fingerprint not in finished}
    scored = {row.pair.id for row in going} - lost
    keys = [unit.fingerprint for unit in own if unit.pair.id in scored]
    track = track_of(config.pairs[0])
    records = reading.read(config.out, keys, track=track) if keys else pa.table({"pair": pa.array([], pa.string())})
    for row in going:
        if row.pair.id in lost or not any(unit.pair.id == row.pair.id for unit in own):
            row.stop = _stop(config, row, "failed")
        else:
            episodes = Episodes.arrange(records.filter(pc.equal(records["pair"], row.pair.id)))
            row.parts.append(episodes.column(track.metric))


def _look(config: RunConfig, rows: Sequence[_Row]) -> None:
    """Stop rows that cannot be the strongest any more, and all of them if the others are known closely enough."""
    going = [row for row in rows if row.stop is None]
    if not going:
        return
    if len(rows) > 1:
        _rule_out(config, rows, going)
        going = [row for row in rows if row.stop is None]
    stops = [_stop(config, row, "narrow") for row in going]
    if all(stop.high - stop.low <= 2 * config.until for stop in stops):  # type: ignore[operator]
        for row, stop in zip(going, stops, strict=True):
            row.stop = stop


def _rule_out(config: RunConfig, rows: Sequence[_Row], going: Sequence[_Row]) -> None:
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
            row.stop = replace(_stop(config, row, "ruled out"), by=tuple(rivals))


def _stop(config: RunConfig, row: _Row, why: str) -> Stop:
    assert config.until is not None
    common = {"pair": row.pair.id, "why": why, "by": (), "until": config.until, "most": config.grid.episodes}
    if not row.parts:
        return Stop(**common, scenarios=0, estimate=0.5, low=0.0, high=1.0)  # type: ignore[arg-type]
    means = row.scores.mean((0, 1))
    low, high = confidence_sequence(means, width=config.until, most=config.grid.episodes)
    bounds = {"estimate": float(means.mean()), "low": float(low[-1]), "high": float(high[-1])}
    return Stop(**common, **bounds, scenarios=len(means))  # type: ignore[arg-type]


def _write(out: Path, stop: Stop) -> None:
    path = out / FOLDER / f"{stop.pair}.json"
    try:
        path.parent.mkdir(exist_ok=True)
        with files.whole(path) as file:
            file.write(json.dumps(asdict(stop), indent=1).encode() + b"\n")
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror}") from error
