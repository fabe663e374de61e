"""From records to comparisons: of every attack on every defended victim, with its controls."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import cache

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from cavbench.core import registry
from cavbench.core.track import Measure, Track, track
from cavbench.leaderboard.comparisons.baselines import Baselines, identity_of
from cavbench.leaderboard.comparisons.comparison import ATTACKER, DEFENDED, NO_ATTACK, Comparison
from cavbench.leaderboard.comparisons.pairing import with_control
from cavbench.records.reading import times
from cavbench.records.schema import AUDIT
from cavbench.records.table import group_codes
from cavbench.statistics.episodes import Episodes

MAKING = "crafting_s"
"""Seconds that an artefact took, on tracks that have one."""
SCENARIO = ("training_seed", "cell", "seed")
CONTROL = (*DEFENDED, "grid")
"""The columns that attacked episodes share with their clean control."""


def measurements(of: Track) -> set[str]:
    """The measurements of a track that leaderboards read, of columns that hold no lists."""
    needed = {of.metric, of.failure, of.place, of.queries, of.gradients} | {one.column for one in headline(of)}
    needed |= {f"{of.artefact[0]}_sha256", MAKING} if of.artefact else set()
    return needed & {field.name for field in of.measurements if not pa.types.is_list(field.type)}


def headline(of: Track) -> tuple[Measure, ...]:
    """The measures of a victim that a leaderboard says beside the metric: those that every table has, and the ranked ones."""
    return tuple(one for one in of.measures if (one.spare == 0 or one.ranked) and not one.of_attack)


def read_comparisons(records: pa.Table, of: Track) -> list[Comparison]:
    """Every attack on every defended victim: by world, victim and defence, the strongest attack first, baselines last.

    Records with attack `none` are the controls. A victim that was never attacked is a comparison of its own, unless it is a
    baseline and there are others. Of a scenario driven twice, the newest record counts.

    Args:
        records: of one track (`cavbench.records.schema`); list columns may be missing.
        of: that track.
    """
    records = distinct(newest(records), of)
    audits = _audits(records)
    records = records.filter(pc.not_equal(records["grid"], AUDIT))
    attack = (*DEFENDED, *ATTACKER, "grid")
    attacked = [
        Episodes.arrange(rows) for _, rows in groups(records, attack, pc.not_equal(records["attack"], NO_ATTACK))
    ]
    clean = groups(records, CONTROL, pc.equal(records["attack"], NO_ATTACK))
    controls = {tuple(identity.values()): Episodes.arrange(newest(rows, CONTROL)) for identity, rows in clean}
    baselines = Baselines(of, [*controls.values(), *attacked])
    found = []
    for own in attacked:
        identity = identity_of(own)
        own, control = with_control(own, controls.get(tuple(identity[name] for name in CONTROL)))
        audit = audits.get(tuple(identity[name] for name in (*DEFENDED, *ATTACKER)))
        found.append(Comparison(identity, of, own, control, baselines.beside(own), audit))
    defended = {tuple(one.identity[name] for name in CONTROL) for one in found}
    alone = [
        Comparison(identity_of(own), of, own, own, baselines.beside(own))
        for drives, own in controls.items()
        if drives not in defended
    ]
    found += [one for one in alone if not one.is_baseline] or ([] if found else alone)
    return sorted(found, key=_rank)


def _audits(records: pa.Table) -> dict[tuple[object, ...], Episodes]:
    """The episodes that an audit drove, by the values of `DEFENDED` and `ATTACKER`."""
    drawn = groups(records, (*DEFENDED, *ATTACKER), pc.equal(records["grid"], AUDIT))
    return {tuple(identity.values()): Episodes.arrange(rows) for identity, rows in drawn}


def read_tracks(records: Mapping[str, pa.Table]) -> list[Comparison]:
    """The comparisons of several tracks, the one with the most records first; without baselines that nobody attacked."""
    ordered = sorted(records.items(), key=lambda item: (-item[1].num_rows, item[0]))
    found = [one for name, table in ordered for one in read_comparisons(table, track(name))]
    return [one for one in found if one.is_attacked or not one.is_baseline]


def _rank(one: Comparison) -> tuple[object, ...]:
    """By world, victim and defence (`none` first); then the strongest attack first, baselines last."""
    text = {name: str(value) for name, value in one.identity.items()}
    score = round(float(one.scores.mean()), 9) if one.is_attacked else -1.0
    return (
        *(text[name] for name in ("world", "world_params", "victim", "victim_params")),
        text["defense"] != "none",
        text["defense"],
        text["defense_params"],
        one.is_baseline,
        score,
        one.content,
    )


def distinct(records: pa.Table, of: Track) -> pa.Table:
    """The records without trainings that are the same network again: of these the first seed counts.

    Trainings are draws of one kind of victim; the same network under a second seed is no second draw. It is the same if the
    weights are, and all that was measured without an attack. Where each seed has an artefact of its own, or an attack that
    learns has a network of its own for each, all count.
    """
    if of.artefact or not records.num_rows:
        return records
    pairs = records.select(["weights_sha256", "training_seed"])
    several = Counter(pairs.group_by(pairs.column_names).aggregate([])["weights_sha256"].to_pylist())
    shared = [name for name, count in several.items() if name and count > 1]
    suspect = pc.is_in(records["weights_sha256"], pa.array(shared, pa.string())).to_numpy()
    if not suspect.any():
        return records
    seed, keep = records["training_seed"].to_numpy(), np.ones(records.num_rows, bool)
    defended, attacks = (
        group_codes(records, (*CONTROL, "weights_sha256")),
        records["attack"].to_numpy(zero_copy_only=False),
    )
    for code in np.unique(defended[suspect]):
        rows = defended == code
        control = np.flatnonzero(rows & (attacks == NO_ATTACK))
        again = _the_same(records.take(pa.array(control)), of)
        taught = [name for name in set(attacks[rows]) if learns(str(name))]
        keep &= ~(rows & np.isin(seed, again) & ~np.isin(attacks, taught))
    return records.filter(pa.array(keep))


def _the_same(control: pa.Table, of: Track) -> list[int]:
    """The training seeds of a control whose every measurement is that of an earlier seed."""
    told = [field.name for field in of.measurements if field.name in control.column_names]
    told = [name for name in told if name not in of.unrepeatable and not pa.types.is_list(control[name].type)]
    seen: dict[str, int] = {}
    again = []
    for seed in sorted(pc.unique(control["training_seed"]).to_pylist()):
        drives = control.filter(pc.equal(control["training_seed"], seed)).select(["cell", "seed", *told])
        content = repr(sorted(map(repr, drives.to_pylist())))
        if seen.setdefault(content, seed) != seed:
            again.append(seed)
    return again


@cache
def learns(attack: str) -> bool:
    """Whether an attack is trained, so that each training seed has another one; false if it is not installed."""
    try:
        return bool(registry.load("attack", attack).learns)
    # The import of a plug-in may raise anything; a report goes on without it.
    except Exception:
        return False


def newest(records: pa.Table, identity: Sequence[str] = (*DEFENDED, *ATTACKER, "grid")) -> pa.Table:
    """The last record of each scenario, in the order given."""
    codes = group_codes(records, (*identity, *SCENARIO))
    rising = np.sort(codes)
    if (rising[1:] > rising[:-1]).all():
        return records
    order = np.lexsort((_by_content(records, codes), times(records), codes))
    last = np.append(codes[order][1:] != codes[order][:-1], True)
    return records.take(pa.array(np.sort(order[last])))


def _by_content(records: pa.Table, codes: NDArray[np.int64]) -> NDArray[np.int64]:
    """A rank of each record among those of its code that no order of files changes: of the same time, the last in it counts."""
    _, where, counts = np.unique(codes, return_inverse=True, return_counts=True)
    ranks = np.zeros(len(codes), np.int64)
    again = np.flatnonzero(counts[where] > 1)
    texts = [repr(row) for row in records.take(pa.array(again)).to_pylist()]
    ranks[again] = np.argsort(np.argsort(np.array(texts), kind="stable"), kind="stable")
    return ranks


def groups(
    records: pa.Table, columns: Sequence[str], keep: pa.ChunkedArray | None = None
) -> Iterator[tuple[dict[str, object], pa.Table]]:
    """The records that share the values of `columns`, in the order of their first appearance."""
    kept = records if keep is None else records.filter(keep)
    if not kept.num_rows:
        return
    codes = group_codes(kept, columns)
    starts = np.flatnonzero(np.append(True, codes[1:] != codes[:-1]))
    together: dict[int, list[NDArray[np.int64]]] = {}
    for start, end in zip(starts, [*starts[1:], len(codes)], strict=True):
        together.setdefault(int(codes[start]), []).append(np.arange(start, end))
    for stretches in together.values():
        first = stretches[0]
        alone = len(stretches) == 1
        part = kept.slice(first[0], len(first)) if alone else kept.take(pa.array(np.concatenate(stretches)))
        yield part.select(list(columns)).slice(0, 1).to_pylist()[0], part
