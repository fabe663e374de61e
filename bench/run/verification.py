"""Drives a submitted pair again, compares its records with what came out, and adds what came out to a results folder."""

from __future__ import annotations

import secrets
import shutil
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc

from cavbench import files
from cavbench.core.track import Track
from cavbench.errors import UserError
from cavbench.records import reading, store
from cavbench.records.finished import finished
from cavbench.run import artefacts, claims, runner
from cavbench.run.claims import Claim
from cavbench.run.replay import differing
from cavbench.run.submission import Submission
from cavbench.run.unit import Unit

CLOSE = 0.02
"""Largest difference of a unit's score between machines or libraries."""
CLOSE_CRAFTED = 0.1
"""The same for the mean score of units with a patch: elsewhere, the same attack crafts another patch."""
STAGING = "verifying"
"""Folder in a results folder for what is not added yet."""
PROBED = ("redrawn", "same_answer", "inconsistent", "draws", "entropy")
"""What probes measured, at moments that are drawn when a unit is driven: never compared, and never taken from a submission."""
ORIGIN = ("code_digest", "libraries", "machine")


@dataclass(frozen=True, kw_only=True)
class Again:
    """A unit that was driven again.

    Args:
        unit: the unit.
        submitted: its records in the submission.
        driven: its records now.
    """

    unit: Unit
    submitted: pa.Table
    driven: pa.Table

    @property
    def changed(self) -> str:
        """What is another here: code, libraries, machine; empty if nothing is."""
        return ", ".join(name for name in ORIGIN if self.submitted[name][0].as_py() != self.driven[name][0].as_py())

    @property
    def differences(self) -> tuple[str, ...]:
        """The columns that differ, but for those that say by what, when and at which moments it was driven."""
        track = self.unit.track
        apart = {*track.unrepeatable, *PROBED}
        names = [column.name for column in (*track.measurements, *track.probes) if column.name not in apart]
        return differing(names, self.submitted, self.driven)

    @property
    def scores(self) -> tuple[float, float]:
        """The mean score submitted, and here."""
        metric = self.unit.track.metric
        return pc.mean(self.submitted[metric]).as_py(), pc.mean(self.driven[metric]).as_py()

    @property
    def said(self) -> str:
        """What came of it, as part of a sentence."""
        if not self.differences:
            return "bit for bit the same"
        before, after = self.scores
        scores = f"{self.unit.track.metric} {before:.3f} recorded, {after:.3f} again"
        why = f"(changed here: {self.changed})" if self.changed else "though nothing has changed"
        return f"{scores}; it differs in {', '.join(self.differences)} {why}"

    @property
    def holds(self) -> bool:
        """Whether it is what the submission says: the same or, by other code or elsewhere, with a score that is close."""
        before, after = self.scores
        return not self.differences or (bool(self.changed) and (self.crafted or abs(before - after) <= CLOSE))

    @property
    def crafted(self) -> bool:
        """Whether something was prepared for it anew, which is not the same elsewhere."""
        return bool(self.unit.artefact)


def hold(every: Sequence[Again]) -> bool:
    """Whether all units are what the submission says, and those with a patch are on average."""
    crafted = [again.scores for again in every if again.crafted and again.changed]
    apart = sum(before - after for before, after in crafted) / max(1, len(crafted))
    return all(again.holds for again in every) and abs(apart) <= CLOSE_CRAFTED


@dataclass(frozen=True, kw_only=True)
class Verified:
    """What was driven.

    Args:
        again: the units of the pair.
        units: all units, with those of its clean control and its baselines, by their fingerprints.
        records: theirs.
    """

    again: Sequence[Again]
    units: Mapping[str, Unit]
    records: pa.Table


def drive(
    found: Submission, claim: Claim, place: Path, watcher: runner.RunWatcher, *, sample: int | None, out: Path | None
) -> Verified:
    """Compare every record of a submission with its pair, then drive some of its units, which nobody could foresee.

    Args:
        found: the submission.
        claim: its claim.
        place: results folder for what is driven.
        watcher: is told what happens.
        sample: how many units; None for all, with the baselines. The clean control is always driven.
        out: a results folder that must not have records of the pair with other weights.

    Raises:
        UserError: names the first column of a record that is not what the pair gives, or if a component fails.
    """
    known: dict[str, Unit] = {}
    submitted: dict[str, pa.Table] = {}

    def choose(units: Mapping[str, Unit]) -> Collection[str]:
        own = [unit for unit in units.values() if unit.pair.id == claim.pair.id]
        named = claims.checked(found.records, own)
        if out is not None:
            claims.check_weights(out, list(units.values()), _there(out, found.track))
        keys = sorted(named)
        chosen = keys if sample is None else secrets.SystemRandom().sample(keys, min(sample, len(keys)))
        submitted.update({named[key].fingerprint: found.records[key] for key in chosen})
        known.update({key: unit for key, unit in units.items() if key in submitted or unit.pair.id != claim.pair.id})
        return known

    plan = replace(claim.plan, out=place, reference=sample is None)
    runner.run(plan, watcher, choose)
    records = reading.read(place, list(known), track=found.track)
    again = [
        Again(unit=known[key], submitted=before, driven=records.filter(pc.equal(records["unit"], key)).sort_by("seed"))
        for key, before in submitted.items()
    ]
    return Verified(again=again, units=known, records=records)


def _check_same(verified: Verified, there: Collection[str], out: Path) -> None:
    """Refuse a results folder with units that say otherwise than what was driven: one of the two is wrong.

    Raises:
        UserError: names the first unit and what differs.
    """
    units = [verified.units[key] for key in sorted(there)]
    if not units:
        return
    before = reading.read(out, list(there), track=units[0].track)
    for unit in units:
        own = pc.equal(before["unit"], unit.fingerprint), pc.equal(verified.records["unit"], unit.fingerprint)
        again = Again(
            unit=unit,
            submitted=before.filter(own[0]).sort_by("seed"),
            driven=verified.records.filter(own[1]).sort_by("seed"),
        )
        if not again.holds:
            raise UserError(
                f"{out} has another record of {unit} than was driven here now ({again.said}): nothing was added; see "
                "which of the two is wrong, or choose another folder with out="
            )


def _there(out: Path, track: Track) -> pa.Table | None:
    """The records of a results folder; None if it has none of the track."""
    return reading.read_all(out).get(track.name) if any((out / store.FOLDER).glob("[!.]*.parquet")) else None


@contextmanager
def staging(out: Path | None, claim: Claim) -> Iterator[Path]:
    """A results folder for what is driven: within `out`, where an interrupted check goes on, or one that is deleted."""
    if out is None:
        with files.scratch() as place:
            yield place
        return
    store.prepare(out)
    yield out / STAGING / claim.pair.id


def add(verified: Verified, place: Path, out: Path) -> tuple[int, int]:
    """Move what was driven to a results folder; a unit that it has already is left as it is.

    Returns:
        How many units were added, and how many were there.

    Raises:
        UserError: if a unit that is there differs from what was driven, before anything is added; or if the folder cannot be
            written.
    """
    there = finished(out, verified.units)
    _check_same(verified, there, out)
    for key, unit in verified.units.items():
        if key in there:
            continue
        if unit.artefact and not artefacts.path_of(out, unit).exists():
            artefacts.write(out, unit, artefacts.read(artefacts.path_of(place, unit)))
        store.write(out, verified.records.filter(pc.equal(verified.records["unit"], key)))
    shutil.rmtree(place, ignore_errors=True)
    return len(verified.units) - len(there), len(there)
