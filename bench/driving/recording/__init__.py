"""Recordings of the driving track: road from above, attacked observations, decisions and perturbation."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from cavbench.driving import DrivingFacts
from cavbench.driving.recording import blueprint, curves, scene
from cavbench.driving.recording.episode import Episode
from cavbench.driving.rollout import Trace
from cavbench.recording.columns import Columns
from cavbench.recording.file import written


def save(trace: Trace, *, facts: DrivingFacts, meta: Mapping[str, object], path: Path) -> None:
    """Write the recording of one episode, atomically.

    Args:
        trace: one episode (`cavbench.driving.rollout.Trace` with one entry in `episodes`).
        facts: facts of the world.
        meta: the record's identity columns: names, parameters, threat model, cell, scenario seed.
        path: path of the `.rrd` file; its folder must exist.

    Raises:
        ValueError: unless the trace holds exactly one episode.
    """
    episode = Episode.of(trace, facts, meta)
    with written(path, meta, blueprint.layout(episode)) as stream:
        columns = Columns(stream, episode.timelines)
        columns.note("about", blueprint.page(episode))
        scene.log(episode, columns)
        curves.log(episode, columns)
