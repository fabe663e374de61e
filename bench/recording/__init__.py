"""Recordings of single episodes for the rerun viewer: what was there, what the victim was shown, what came of it.

A recording is a view of an episode, never its record: rerun reads the files of neighbouring versions only.
"""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import rerun as rr
import rerun.blueprint as rrb

from bench.recording import about
from bench.recording.columns import Columns
from bench.recording.detection import approach
from bench.recording.detection import blueprint as approach_blueprint
from bench.recording.driving import blueprint, curves, scene
from bench.recording.driving.episode import Episode

if TYPE_CHECKING:
    from bench.detection.approach import Sighting
    from bench.driving.contracts import Features
    from bench.driving.rollout import Trace

__all__ = ["save", "save_approach"]


def save(trace: Trace, *, features: Features, meta: Mapping[str, object], path: Path) -> None:
    """Write the recording of one episode; the file appears whole or not at all.

    Args:
        trace: one episode (`bench.driving.rollout.Trace` with one entry in `episodes`).
        features: of its observations.
        meta: the record's identity columns: names, parameters, threat model, cell, scenario seed.
        path: of the `.rrd` file; its folder exists.

    Raises:
        ValueError: unless the trace holds exactly one episode.
    """
    episode = Episode.of(trace, features, meta)
    with _written(path, meta, blueprint.layout(episode)) as stream:
        columns = Columns(stream, episode.timelines)
        columns.note("about", blueprint.page(episode))
        scene.log(episode, columns)
        curves.log(episode, columns)


def save_approach(sighting: Sighting, *, meta: Mapping[str, object], path: Path) -> None:
    """Write the recording of one approach; the file appears whole or not at all.

    Args:
        sighting: what was seen on it.
        meta: as for `save`.
        path: as for `save`.
    """
    with _written(path, meta, approach_blueprint.layout(sighting)) as stream:
        approach.log(sighting, meta, stream)


@contextmanager
def _written(path: Path, meta: Mapping[str, object], layout: rrb.Blueprint) -> Iterator[rr.RecordingStream]:
    """A recording that is written aside, and renamed at the end; not at all if the block raises."""
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    name = uuid.uuid5(uuid.NAMESPACE_URL, f"{meta.get('unit', '')}/{meta.get('seed', '')}/{path.name}")
    try:
        with rr.RecordingStream("cavbench", recording_id=name) as stream:
            stream.save(draft, default_blueprint=layout)
            stream.send_recording_name(about.title(meta))
            yield stream
            stream.flush()
        stream.disconnect()
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)
