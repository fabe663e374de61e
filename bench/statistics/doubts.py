"""What casts doubt on a score, from the records of a defended victim alone: the same words and thresholds under every table.

A measurement fires, does not fire, or says that it was not made. `remarks` is what stands under a table: the flags of a
leaderboard (docs/leaderboard.md) that need no other attack to compare with, and what else makes a number mean something else.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cavbench.core.pair import label
from cavbench.core.track import Track
from cavbench.errors import UserError

SAME, MASKED, NOT_FINITE, DRAWN, ONE_DRAW = 0.99, 0.5, 0.01, 0.01, 2.0
"""Thresholds: the share of probes from which on the answer depends on no input; of gradients that are 0 everywhere, and that are
not finite somewhere; of probes from which on a victim is random; and the questions a point below which it was attacked with one
draw."""
Finding = tuple[bool | None, str]
"""Whether it fires, None where it was not measured; and the measurement in one sentence."""
TITLES = {
    "ignores_input": "the answer does not depend on the input",
    "two_faced": "its answers to attacks differ from its actions",
    "zero_gradients": "gradients are zero",
    "nan_gradients": "gradients are not finite",
    "one_draw": "random, but attacked with one draw",
}
"""What each measurement says where it fires."""
OF_VICTIM = ("provenance", "trained_elsewhere", "hopeless", "always_fails")
"""Remarks that are about the victim under every attack, and without one."""


@dataclass(frozen=True)
class Remark:
    """What a reader must know before trusting a number.

    Args:
        name: of the flag, or of what was found.
        about: whose number it is: attack, defence and victim.
        text: in one sentence.
    """

    name: str
    about: str
    text: str

    def __str__(self) -> str:
        return f"{self.about}: {self.text}" if self.about else self.text


def mean(records: pa.Table, name: str) -> float:
    """Mean of a column, without nulls; NaN where there is nothing else, or no such column."""
    if name not in records.column_names:
        return math.nan
    found = pc.mean(records[name].cast(pa.float64())).as_py()
    return math.nan if found is None else float(found)


def share(tables: Sequence[pa.Table], name: str) -> float:
    """Mean of a probe over several tables of records; NaN where none measured it."""
    found = [value for table in tables if not math.isnan(value := mean(table, name))]
    return math.fsum(found) / len(found) if found else math.nan


def ignores_input(tables: Sequence[pa.Table], track: Track) -> Finding:
    """Fires where the victim gives the same answer on another input in at least 99 % of probes."""
    found = share(tables, "same_answer")
    if math.isnan(found):
        return None, "Not measured: the records have no probes of the input."
    return found >= SAME, f"On {track.other_input} it gave the same answer in {100 * found:.1f} % of probes."


def two_faced(tables: Sequence[pa.Table]) -> Finding:
    """Fires where at least 1 % of the answers to probes, asked as an attack asks, differ from the victim's actions."""
    found = share(tables, "inconsistent")
    if math.isnan(found):
        return None, "Not measured: the records have no probes of an attack's paths."
    return found >= DRAWN, f"In {100 * found:.1f} % of probes its answer to an attack's query differs from its action."


def zero_gradients(attacked: Sequence[pa.Table]) -> Finding:
    """Fires where at least half of the gradients that an attack used were zero everywhere."""
    largest = _largest(attacked, "zero_gradients")
    if math.isnan(largest):
        return None, "Not measured: no attack used gradients, or the records do not count them."
    return largest >= MASKED, f"{100 * largest:.0f} % of the gradients that an attack used were zero everywhere."


def nan_gradients(attacked: Sequence[pa.Table]) -> Finding:
    """Fires where at least 1 % of the gradients that an attack used had an entry that is NaN or infinite."""
    largest = _largest(attacked, "nan_gradients")
    if math.isnan(largest):
        return None, "Not measured: no attack used gradients, or the records do not count those that are not finite."
    return (
        largest >= NOT_FINITE,
        f"{100 * largest:.0f} % of the gradients that an attack used had an entry that is NaN or infinite.",
    )


def one_draw(tables: Sequence[pa.Table], attacked: Sequence[pa.Table], track: Track) -> Finding:
    """Fires where the victim gives another answer when asked again, and no attack asked about each observation twice."""
    redrawn = share(tables, "redrawn")
    if math.isnan(redrawn):
        return None, "Not measured: the records have no probes of randomness."
    if redrawn < DRAWN:
        return False, "Asked the same twice, it gave the same answer: it is not random."
    if track.many_draws:
        return False, track.many_draws
    if _largest(attacked, "queries") == 0:
        return None, "Not measured: no attack asked the victim anything."
    draws = _largest(attacked, "draws")
    draws = 0.0 if math.isnan(draws) else draws
    asked = f"the attack with the most draws asked {draws:.1f} times about each observation"
    return (
        draws < ONE_DRAW,
        f"Asked the same twice, it gave another answer in {100 * redrawn:.0f} % of probes; {asked}.",
    )


def _largest(tables: Sequence[pa.Table], name: str) -> float:
    return max((value for table in tables if not math.isnan(value := mean(table, name))), default=math.nan)


def remarks(attacked: pa.Table | None, clean: pa.Table | None, track: Track, about: str = "") -> Iterator[Remark]:
    """What the records of one attack on a defended victim say against its number.

    Args:
        attacked: its records; None where nothing was attacked.
        clean: those of the clean control; None where it was not driven.
        track: of the victim.
        about: whose number it is, for the line.
    """
    tables = [table for table in (attacked, clean) if table is not None]
    if not tables or not tables[0].num_rows:
        return
    under = [] if attacked is None else [attacked]
    found = {
        "ignores_input": ignores_input(tables, track),
        "two_faced": two_faced(tables),
        "zero_gradients": zero_gradients(under),
        "nan_gradients": nan_gradients(under),
        "one_draw": one_draw(tables, under, track) if under else (None, ""),
    }
    for name, (fired, reason) in found.items():
        if fired:
            yield Remark(name, about, f"{TITLES[name]}. {reason}")
    yield from of_victim(tables[0], clean, track, about)


def of_victim(records: pa.Table, clean: pa.Table | None, track: Track, about: str = "") -> Iterator[Remark]:
    """What the records say of the victim itself: where it comes from, and whether it does anything without an attack."""
    params = json.loads(records["victim_params"][0].as_py() or "{}")
    victim, trained_in = records["victim"][0].as_py(), params.get("trained_in", "")
    if trained_in == "unknown":
        yield Remark(
            "provenance",
            about,
            f"provenance unknown: {victim} comes from outside, and nothing says in which environment it was trained (ranges, "
            "rate, order of features); state it with victim.trained_in=…",
        )
    # The recipes of the zoo list parameters instead (`vehicles=5`); a run compares them with its world before it drives.
    elif (
        trained_in
        and not ("=" in trained_in and "(" not in trained_in)
        and trained_in != _environment(records)
        and trained_in != (world := _world(records))
    ):
        yield Remark("trained_elsewhere", about, f"trained in {trained_in}, scored in {world}")
    if clean is None or not clean.num_rows:
        return
    column, what = track.blind_at_zero
    if column not in clean.column_names:
        column, what = track.metric, f"its {track.metric_title} is 0 in every {track.episode[0]}"
    if not np.nan_to_num(clean[column].to_numpy(zero_copy_only=False).astype(float)).any():
        yield Remark(
            "hopeless", about, f"{what} without an attack, so it has no rank: are the settings of {victim} right?"
        )
    elif track.failure and clean[track.failure].to_numpy(zero_copy_only=False).astype(float).all():
        yield Remark(
            "always_fails",
            about,
            f"it fails in every {track.episode[0]} without an attack: are the settings of {victim} right?",
        )


def of_runs(runs: int, track: Track, about: str = "", *, trained: bool = True) -> Iterator[Remark]:
    """A remark where a victim that learns, or a patch, was measured once."""
    if trained and runs == 1:
        once = f"its one {track.run} says nothing about others: the interval is about other {track.episode[1]} only"
        yield Remark("one_training", about, once)


def of_baselines(baselines: Sequence[pa.Table], track: Track) -> Iterator[Remark]:
    """A remark where each victim that is a baseline fails in every episode."""
    if not (track.failure and baselines and track.contrast and track.contrast.side == "victim"):
        return
    if all(one[track.failure].to_numpy(zero_copy_only=False).astype(float).all() for one in baselines):
        world = baselines[0]["world"][0].as_py()
        text = (
            f"every baseline fails in every {track.episode[0]}: {world}, or what it counts as a failure, may be wrong"
        )
        yield Remark("baselines_fail", "", text)


def above_members(strongest: float, members: dict[str, float], about: str = "") -> Iterator[Remark]:
    """A remark where the score under the strongest attack of each cell is above that under one of the attacks."""
    name, lowest = min(members.items(), key=lambda item: (item[1], item[0]))
    if round(strongest, 3) > round(lowest, 3):
        text = (
            f"{strongest:.3f} under the strongest attacks is above {lowest:.3f} under {name} alone: in each cell the attack is "
            "chosen on other scenarios than it is scored on, so that luck cannot lower the score; with few scenarios the choice "
            "misses (cross-fitting)"
        )
        yield Remark("cross_fitting", about, text)


def _world(records: pa.Table) -> str:
    """The world as tables name it, with the parameters that are not its defaults."""
    name = records["world"][0].as_py()
    try:
        return label("world", name, json.loads(records["world_params"][0].as_py() or "{}"))
    except (UserError, ValueError):
        return str(name)


def _environment(records: pa.Table) -> str:
    """The id of the gymnasium environment that a world is made of, if it names one and changes nothing in it."""
    params = json.loads(records["world_params"][0].as_py() or "{}")
    return "" if params.get("config") or params.get("axes") else str(params.get("id", ""))
