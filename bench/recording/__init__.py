"""Recordings of single episodes for the rerun viewer: what was measured, what the policy was shown, what it did.

A recording is a view of an episode, never its record: rerun reads the files of neighbouring versions only.
"""

from __future__ import annotations

import os
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import rerun as rr

from bench.recording import blueprint, curves, scene
from bench.recording.columns import Columns
from bench.recording.episode import Episode
from bench.recording.logger import RerunLogger

if TYPE_CHECKING:
    from bench.driving import Features
    from bench.rollout import Trace

__all__ = ["RerunLogger", "save"]


def save(trace: Trace, *, features: Features, meta: Mapping[str, object], path: Path) -> None:
    """Write the recording of one episode; the file appears whole or not at all.

    Args:
        trace: one episode (`bench.rollout.Trace` with one entry in `episodes`).
        features: of its observations.
        meta: the record's identity columns: names, parameters, threat model, cell, scenario seed.
        path: of the `.rrd` file; its folder exists.

    Raises:
        ValueError: unless the trace holds exactly one episode.
    """
    episode = Episode.of(trace, features, meta)
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    name = uuid.uuid5(uuid.NAMESPACE_URL, f"{meta.get('unit', '')}/{meta.get('seed', '')}/{path.name}")
    try:
        with rr.RecordingStream("cavbench", recording_id=name) as stream:
            stream.save(draft, default_blueprint=blueprint.layout(episode))
            stream.send_recording_name(blueprint.title(episode))
            columns = Columns(stream, len(episode))
            columns.note("about", blueprint.about(episode))
            scene.log(episode, columns)
            curves.log(episode, columns)
            stream.flush()
        stream.disconnect()
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)
