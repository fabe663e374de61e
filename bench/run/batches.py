"""Puts units together that are driven in one batch: it shares what is the same for all, or takes as long for one as for many."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from cavbench.run.unit import Preparation, Unit

EPISODES = 400
"""Most episodes in one batch: an operation on more does not fit into the processor's cache."""
TASKS = 4
"""Fewest tasks for each worker, so that all workers end at about the same time."""

Works = Sequence[Preparation | Unit]


def batches(works: Works, recorded: Collection[str], workers: int) -> list[Works]:
    """The works in batches of units that are alike (`Track.alike`); alone, what cannot be driven together.

    Args:
        works: in the order in which they should begin.
        recorded: fingerprints of the units that are recorded, which are driven alone.
        workers: number of worker processes.
    """
    alike: dict[object, list[Preparation | Unit]] = {}
    for place, work in enumerate(works):
        single = isinstance(work, Preparation) or work.fingerprint in recorded
        key = None if single else work.track.alike(work.job)
        alike.setdefault(place if key is None else key, []).append(work)
    most = max(1, len(works) // (TASKS * workers))
    found: list[Works] = []
    for group in alike.values():
        size = max(1, min(most, EPISODES // len(group[0].seeds)))
        found += [group[start : start + size] for start in range(0, len(group), size)]
    return found
