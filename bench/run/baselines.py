"""The baselines of a run: whether any of them ever drives well."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from cavbench.core.track import track_of
from cavbench.records import reading
from cavbench.run.config import RunConfig
from cavbench.run.unit import Unit


def hopeless(config: RunConfig, units: Iterable[Unit], finished: Collection[str]) -> str:
    """What the track says if all baselines of a run fail in all their episodes; empty otherwise.

    Args:
        config: the run.
        units: its units.
        finished: fingerprints of those that have records.
    """
    if not config.reference:
        return ""
    track = track_of(config.pairs[0])
    names = {other.id for pair in config.pairs for other in track.baselines(pair)} - {pair.id for pair in config.pairs}
    own = [unit.fingerprint for unit in units if unit.pair.id in names and unit.fingerprint in finished]
    return track.hopeless(reading.read(config.out, own, track=track)) if own else ""
