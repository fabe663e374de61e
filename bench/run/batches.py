"""Puts tasks together that are driven in one batch: it shares what is the same for all, or takes as long for one as for many."""

from __future__ import annotations

from collections.abc import Collection, Hashable, Sequence

from cavbench.run.task import Task
from cavbench.run.unit import Unit

EPISODES = 400
"""Most episodes in one batch: an operation on more does not fit into the processor's cache."""
TASKS = 4
"""Fewest batches for each worker, so that all workers end at about the same time."""


def batches(tasks: Sequence[Task], recorded: Collection[str], workers: int) -> list[list[Task]]:
    """The tasks in batches of units that are alike (`Track.alike`); alone, what cannot be driven together.

    Units of a pair with the same frames are never parted: together they take little longer than one.

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
        parts: dict[object, list[Task]] = {}
        for place, task in enumerate(group):
            frames = None if task.step != "drive" else _frames(task.unit)
            parts.setdefault(place if frames is None else frames, []).append(task)
        batch: list[Task] = []
        for part in parts.values():
            if batch and len(batch) + len(part) > size:
                found.append(batch)
                batch = []
            batch = [*batch, *part]
        found.append(batch)
    return found


def _frames(unit: Unit) -> Hashable | None:
    """Equal for units of a pair whose cells have the same frames; None in a world where all cells have others."""
    axes = unit.pair.world.component.facts.axes
    if not any(axis.unseen for axis in axes.axes):
        return None
    return unit.pair.id, unit.training_seed, tuple(axes.looked_at(unit.cell).items()), unit.seeds
