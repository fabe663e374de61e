"""Recordings of the driving track: the road from above, what the policy was shown, its decisions, the perturbation."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from bench.driving import DrivingFacts
from bench.driving.rollout import Trace
from bench.recording.columns import Columns
from bench.recording.driving import blueprint, curves, scene
from bench.recording.driving.episode import Episode
from bench.recording.file import written


def save(trace: Trace, *, facts: DrivingFacts, meta: Mapping[str, object], path: Path) -> None:
    """Write the recording of one episode; the file appears whole or not at all.

    Args:
        trace: one episode (`bench.driving.rollout.Trace` with one entry in `episodes`).
        facts: of the world.
        meta: the record's identity columns: names, parameters, threat model, cell, scenario seed.
        path: of the `.rrd` file; its folder exists.

    Raises:
        ValueError: unless the trace holds exactly one episode.
    """
    episode = Episode.of(trace, facts, meta)
    with written(path, meta, blueprint.layout(episode)) as stream:
        columns = Columns(stream, episode.timelines)
        columns.note("about", blueprint.page(episode))
        scene.log(episode, columns)
        curves.log(episode, columns)
