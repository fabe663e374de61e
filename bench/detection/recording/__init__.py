"""Recordings of the detection track: the frames with and without the patch, the detector's output, and the patch."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from cavbench.detection.approach import Sighting
from cavbench.detection.recording import approach, blueprint
from cavbench.recording.file import written


def save(sighting: Sighting, *, meta: Mapping[str, object], path: Path) -> None:
    """Write the recording of one approach, atomically.

    Args:
        sighting: the detector's output on the approach.
        meta: the record's identity columns: names, parameters, threat model, cell, scenario seed.
        path: path of the `.rrd` file; its folder must exist.
    """
    with written(path, meta, blueprint.layout(sighting)) as stream:
        approach.log(sighting, meta, stream)
