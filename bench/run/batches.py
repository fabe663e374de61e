"""Puts tasks together that are driven in one batch: it shares what is the same for all, or takes as long for one as for many."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from cavbench.run.task import Task

EPISODES = 400
"""Most episodes in one batch: an operation on more does not fit into the processor's cache."""
TASKS = 4
"""Fewest batches for each worker, so that all workers end at about the same time."""


def batches(tasks: Sequence[Task], recorded: Collection[str], workers: int) -> list[list[Task]]:
    """The tasks in batches of units that are alike (`Track.alike`); alone, what cannot be driven together.

    Args:
        tasks: of a unit each, in the order in which they should begin.
        recorded: fingerprints of the units that are recorded, which are driven alone.
        workers: number of worker processes.
    """
    alike: dict[object, list[Task]] = {}
    for place, task in enumerate(tasks):
        # A fingerprint reads the code of all components.
        single = task.step != "drive" or bool(recorded and task.unit.fingerprint in recorded)
        key = None if single else task.unit.track.alike(task.unit.job)
        alike.setdefault(place if key is None else key, []).append(task)
    most = max(1, len(tasks) // (TASKS * workers))
    found: list[list[Task]] = []
    for group in alike.values():
        size = max(1, min(most, EPISODES // len(group[0].unit.seeds)))
        found += [group[start : start + size] for start in range(0, len(group), size)]
    return found
