"""The results folder of a run: what is there already, and each outcome as it comes."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import cache
from pathlib import Path

import pyarrow as pa

from cavbench import files
from cavbench.core.track import Track
from cavbench.records import packing, reading, store
from cavbench.records.finished import finished as finished_units
from cavbench.run import artefacts
from cavbench.run.task import Outcome, Task
from cavbench.run.unit import Unit
from cavbench.scenarios import Cell
from cavbench.scenarios.axes import written


class Results:
    """A results folder. Finished units are packed as the run goes on (`cavbench.records.packing`).

    Args:
        folder: made if it is not there.

    Raises:
        UserError: if it cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        store.prepare(folder)
        self.folder = folder
        self._unpacked = 0
        self._read = cache(artefacts.read)

    def finished(self, units: Mapping[str, Unit]) -> set[str]:
        """The fingerprints among these that have records. What is wrong is set aside, what was left by a run is packed."""
        found = finished_units(self.folder, units)
        packing.pack(self.folder)
        return found

    def records(self, units: Sequence[str], track: Track) -> pa.Table:
        """The records of finished units, by their fingerprints."""
        return reading.read(self.folder, units, track=track)

    def lacks(self, unit: Unit) -> bool:
        """Whether the artefact of a unit must be prepared."""
        return bool(unit.artefact) and not artefacts.path_of(self.folder, unit).exists()

    def artefacts(self, units: Collection[Unit]) -> dict[str, bytes]:
        """The contents of the files of the units' artefacts, by `Unit.artefact`."""
        return {unit.artefact: self._read(artefacts.path_of(self.folder, unit)) for unit in units if unit.artefact}

    def keep(self, kept: Sequence[tuple[Task, Outcome]]) -> None:
        """Write the outcomes of tasks of a unit each: the records last, because they mark a unit as finished."""
        records: dict[Track, list[pa.Table]] = {}
        for task, outcome in kept:
            if outcome.artefact is not None:
                artefacts.write(self.folder, task.unit, outcome.artefact)
                continue
            for seed, recording in outcome.recordings.items():
                keep_recording(recording_path(self.folder, task.unit, seed), recording)
            assert outcome.records is not None
            records.setdefault(task.unit.track, []).append(outcome.records)
        for units in records.values():
            store.write_all(self.folder, units)
            self._unpacked += len(units)
        if self._unpacked >= packing.UNITS:
            packing.pack(self.folder)
            self._unpacked = 0


def keep_recording(path: Path, content: bytes) -> None:
    """Write a recording atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with files.whole(path) as file:
        file.write(content)


def recording_path(out: Path, unit: Unit, seed: int) -> Path:
    """The file of an episode's recording."""
    return out / "recordings" / unit.pair.id / f"{stem(unit.cell, seed)}.rrd"


def stem(cell: Cell, seed: int) -> str:
    """The name of an episode in the names of files: `lanes-3-density-1-weather-clear-1000000`."""
    return "-".join([*(f"{name}-{written(value)}" for name, value in cell.items()), str(seed)])
