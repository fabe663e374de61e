"""From records to pairs: an attack on a defended victim, beside its clean control and the reference drivers."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from bench.scenarios import Cell
from bench.statistics.episodes import Episodes, Summary, difference, shared, summarise, unit_interval
from bench.statistics.estimates import Interval, iqm

DEFENDED = ("defense", "defense_params", "victim", "victim_params", "world", "world_params")
"""What drives: the columns that a clean control shares with the attacked episodes."""
ATTACKER = ("attack", "attack_params", "threat_norm", "threat_budget", "threat_access", "threat_queries")
BEST_BLIND, IDM = "best blind", "idm"
SCENARIO = ("training_seed", "lanes", "density", "weather", "seed")


@dataclass(frozen=True)
class Pair:
    """One attack on one defended victim, and what it is measured against; all on the same scenarios.

    Args:
        identity: the values of `DEFENDED`, `ATTACKER` and `grid`; the attack is `none` where only the control was
            driven.
        attacked: the episodes under attack; None where only the control was driven.
        clean: the same scenarios without an attack; None where they were not driven.
        references: the episodes of drivers that neither learn nor see, by name: `best blind`, `random`, `idm`.
    """

    identity: Mapping[str, object]
    attacked: Episodes | None
    clean: Episodes | None
    references: Mapping[str, Episodes]

    @property
    def driven(self) -> Episodes:
        """The attacked episodes, or the clean ones where nothing was attacked."""
        found = self.attacked or self.clean
        assert found is not None
        return found

    @property
    def cells(self) -> tuple[Cell, ...]:
        """The cells that were driven."""
        return self.driven.cells

    def only(self, cells: Sequence[Cell]) -> Pair:
        """The same pair in some of its cells."""

        def part(drive: Episodes | None) -> Episodes | None:
            return drive.only(cells=cells) if drive and set(cells) & set(drive.cells) else None

        references = {name: kept for name, drive in self.references.items() if (kept := part(drive))}
        return Pair(self.identity, part(self.attacked), part(self.clean), references)

    @cached_property
    def attacked_summary(self) -> Summary | None:
        return summarise(self.attacked) if self.attacked else None

    @cached_property
    def clean_summary(self) -> Summary | None:
        return summarise(self.clean) if self.clean else None

    @cached_property
    def lead(self) -> Interval | None:
        """Attacked - best blind safe progress, paired: below 0 the victim would do better with its eyes shut."""
        control = self.references.get(BEST_BLIND)
        if control is None or self.attacked is None:
            return None
        return difference(*shared(self.attacked, control), "safe_progress")

    @cached_property
    def reference_scores(self) -> dict[str, Interval]:
        """Safe progress of the reference drivers; they have no training seeds, so one run says it all."""
        return {
            name: unit_interval(drive.only(runs=drive.runs[:1]).column("safe_progress"))
            for name, drive in self.references.items()
        }

    @property
    def retained(self) -> float:
        """Attacked over clean safe progress; NaN where the clean one is unknown or 0."""
        clean, attacked = self.clean_summary, self.attacked_summary
        if clean is None or attacked is None or clean.safe_progress.estimate <= 0:
            return float("nan")
        return attacked.safe_progress.estimate / clean.safe_progress.estimate


def read_pairs(records: pa.Table) -> list[Pair]:
    """Every pair in the records: by world, victim and defence, the strongest attack first.

    Records with attack `none` are the controls; a victim that was never attacked is a pair of its own, unless it is a
    reference driver and there are others. Of a scenario driven twice, the newest record counts.
    """
    records = newest(records)
    attacked = [group for group in groups(records, (*DEFENDED, *ATTACKER, "grid")) if group[0]["attack"] != "none"]
    clean = groups(records, DEFENDED, pc.equal(records["attack"], "none"))
    controls = {_drives(identity): Episodes.arrange(newest(rows, DEFENDED)) for identity, rows in clean}
    known: dict[tuple[object, ...], dict[str, Episodes]] = {}
    pairs = [_pair(identity, rows, controls, known) for identity, rows in attacked]
    used = {_drives(pair.identity) for pair in pairs}
    alone = [drives for drives, drive in controls.items() if drives not in used and drive.table["sees"][0].as_py()]
    if not pairs and not alone:
        alone = list(controls)
    pairs += [_pair(_first(controls[drives]), None, controls, known) for drives in alone]
    return sorted(pairs, key=_rank)


def newest(records: pa.Table, identity: tuple[str, ...] = (*DEFENDED, *ATTACKER, "grid")) -> pa.Table:
    """The last record of each scenario, in the order given."""
    codes = codes_of(records, (*identity, *SCENARIO))
    rising = np.sort(codes)
    if (rising[1:] > rising[:-1]).all():
        return records
    created = records["created_at"].cast(pa.int64()).to_numpy()
    order = np.lexsort((np.arange(len(codes)), created, codes))
    last = np.append(codes[order][1:] != codes[order][:-1], True)
    return records.take(pa.array(np.sort(order[last])))


def groups(
    records: pa.Table, columns: tuple[str, ...], keep: pa.ChunkedArray | None = None
) -> Iterator[tuple[dict[str, object], pa.Table]]:
    """The records that share the values of `columns`, in the order of their first appearance."""
    kept = records if keep is None else records.filter(keep)
    if not kept.num_rows:
        return
    codes = codes_of(kept, columns)
    starts = np.flatnonzero(np.append(True, codes[1:] != codes[:-1]))
    together: dict[int, list[NDArray[np.int64]]] = {}
    for start, end in zip(starts, [*starts[1:], len(codes)], strict=True):
        together.setdefault(int(codes[start]), []).append(np.arange(start, end))
    for stretches in together.values():
        first = stretches[0]
        alone = len(stretches) == 1
        part = kept.slice(first[0], len(first)) if alone else kept.take(pa.array(np.concatenate(stretches)))
        yield part.select(columns).slice(0, 1).to_pylist()[0], part


def codes_of(records: pa.Table, columns: Sequence[str]) -> NDArray[np.int64]:
    """A number for each record, the same for those that share the values of `columns`."""
    codes = np.zeros(records.num_rows, np.int64)
    kinds = 1
    for name in columns:
        column = records[name].combine_chunks()
        column = column if pa.types.is_dictionary(column.type) else column.dictionary_encode()
        more = len(column.dictionary)
        if kinds * more > 2**62:
            distinct, codes = np.unique(codes, return_inverse=True)
            kinds = len(distinct)
        codes, kinds = codes * more + column.indices.to_numpy(), kinds * more
    return codes


def _drives(identity: Mapping[str, object]) -> tuple[object, ...]:
    return tuple(identity[name] for name in DEFENDED)


def _first(drive: Episodes) -> dict[str, object]:
    """Of the columns that all records of a pair share."""
    shared = (*DEFENDED, *ATTACKER, "grid", "action_type", "sees")
    return dict(drive.table.select(shared).slice(0, 1).to_pylist()[0])


def _pair(
    identity: Mapping[str, object],
    rows: pa.Table | None,
    controls: Mapping[tuple[object, ...], Episodes],
    known: dict[tuple[object, ...], dict[str, Episodes]],
) -> Pair:
    """One pair; `known` remembers the reference drivers of the same scenarios."""
    clean = controls.get(_drives(identity))
    attacked = Episodes.arrange(rows) if rows is not None else None
    if attacked and clean:
        try:
            attacked, clean = shared(attacked, clean)
        except ValueError:
            clean = None
    driven = attacked or clean
    assert driven is not None
    own = _first(driven)
    key = (*(own[name] for name in ("world", "world_params", "action_type")), driven.runs, driven.cells, driven.seeds)
    if key not in known:
        known[key] = references(driven, controls.values())
    return Pair(identity, attacked, clean, known[key])


def references(driven: Episodes, controls: Iterable[Episodes]) -> dict[str, Episodes]:
    """The reference drivers on the scenarios of `driven`: in its world and, where they obey actions, of its action
    type.

    The best blind policy is chosen cell by cell on the very scenarios it is reported on: that favours it, and so is
    hard on the victim.
    """
    own = _first(driven)
    candidates: dict[str, list[Episodes]] = {}
    for control in controls:
        its = _first(control)
        same_world = all(own[name] == its[name] for name in ("world", "world_params"))
        same_actions = own["action_type"] == its["action_type"] or its["victim"] == IDM
        if same_world and same_actions and its["defense"] == "none" and not its["sees"]:
            name = BEST_BLIND if its["victim"] == "blind" else str(its["victim"])
            candidates.setdefault(name, []).append(control)
    found = {name: _best(candidates[name], driven) for name in sorted(candidates, key=_reference_rank)}
    return {name: drive for name, drive in found.items() if drive is not None}


def _reference_rank(name: str) -> tuple[int, str]:
    order = (BEST_BLIND, "random", IDM)
    return (order.index(name) if name in order else len(order), name)


def _best(candidates: list[Episodes], driven: Episodes) -> Episodes | None:
    """Of each cell the candidate with the highest mean safe progress, named after the runs and weathers of `driven`."""
    chosen: dict[Cell, tuple[float, pa.Table]] = {}
    for candidate in candidates:
        for cell, score, rows in _cell_by_cell(candidate, driven):
            if cell not in chosen or score > chosen[cell][0]:
                chosen[cell] = (score, rows)
    if not chosen:
        return None
    best = Episodes.arrange(pa.concat_tables([rows for _, rows in chosen.values()]))
    return best.standing_for(driven.runs, best.cells)


def _cell_by_cell(candidate: Episodes, driven: Episodes) -> Iterator[tuple[Cell, float, pa.Table]]:
    """The candidate's mean safe progress and records in each cell of `driven` that it can stand for, as one run."""
    covered = [cell for cell in driven.cells if {cell, replace(cell, weather="clear")} & set(candidate.cells)]
    if not covered or not set(driven.seeds) <= set(candidate.seeds):
        return
    drive = candidate.standing_for(driven.runs[:1], covered).only(seeds=driven.seeds)
    for cell in covered:
        part = drive.only(cells=[cell])
        yield cell, float(part.column("safe_progress").mean()), part.table


def _rank(pair: Pair) -> tuple[object, ...]:
    """By world, victim and defence (`none` first), then the strongest attack first."""
    text = {name: str(value) for name, value in pair.identity.items()}
    score = float(iqm(pair.attacked.column("safe_progress").mean(2))) if pair.attacked else -1.0
    return (
        *(text[name] for name in ("world", "world_params", "victim", "victim_params")),
        text["defense"] != "none",
        text["defense"],
        text["defense_params"],
        score,
    )


def parameters(canonical: object) -> dict[str, object]:
    """The parameters of a component from the canonical JSON of a record."""
    found = json.loads(str(canonical) or "{}")
    return dict(found) if isinstance(found, dict) else {}
