"""Recordings of the detection track: the frames with and without the patch, what the detector says of them, and the patch."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from bench.detection.approach import Sighting
from bench.recording.detection import approach, blueprint
from bench.recording.file import written


def save(sighting: Sighting, *, meta: Mapping[str, object], path: Path) -> None:
    """Write the recording of one approach; the file appears whole or not at all.

    Args:
        sighting: what was seen on it.
        meta: the record's identity columns: names, parameters, threat model, cell, scenario seed.
        path: of the `.rrd` file; its folder exists.
    """
    with written(path, meta, blueprint.layout(sighting)) as stream:
        approach.log(sighting, meta, stream)
