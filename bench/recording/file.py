"""Writes the file of a recording atomically."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from cavbench.recording import about


@contextmanager
def written(path: Path, meta: Mapping[str, object], layout: rrb.Blueprint) -> Iterator[rr.RecordingStream]:
    """A recording written to a temporary file, which is renamed at the end, or deleted if the block raises."""
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
