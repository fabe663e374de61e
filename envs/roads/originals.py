"""highway-env's own tasks as it registers them: each with its default configuration, for comparisons with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from cavbench.envs.roads import roundabout
from cavbench.envs.roads.config import RoadsConfig, Scene, TaskKind
from cavbench.envs.roads.merge import CLASSIC_END, classic, generic, spots
from cavbench.envs.roads.network import record


def _merge(*, connected: bool) -> RoadsConfig:
    net = classic(connected=connected)
    return RoadsConfig(
        task=TaskKind.MERGE_CLASSIC, scenes=(Scene(road=record(net, spots=spots(net), end=CLASSIC_END), capacity=6),)
    )


def _merge_generic(*, connected: bool) -> RoadsConfig:
    net = generic(lanes=2, before=150.0, converge=80.0, parallel=80.0, after=150.0, connected=connected)
    road = record(net, spots=spots(net), end=150.0 + 80 + 80 + 150 - 90)
    return RoadsConfig(task=TaskKind.MERGE_GENERIC, scenes=(Scene(road=road, traffic=3, capacity=6),))


def _roundabout(*, connected: bool) -> RoadsConfig:
    net = roundabout.roundabout(connected=connected)
    road = record(net, spots=roundabout.spots(net), destinations=roundabout.DESTINATIONS)
    return RoadsConfig(
        task=TaskKind.ROUNDABOUT,
        scenes=(Scene(road=road, capacity=5),),
        duration=11.0,
        target_speeds=(0.0, 8.0, 16.0),
        low=(-100.0, -100.0, -15.0, -15.0),
        high=(100.0, 100.0, 15.0, 15.0),
        relative=False,
    )


ORIGINALS: dict[str, Callable[[], RoadsConfig]] = {
    "merge-v0": lambda: _merge(connected=False),
    "merge-v1": lambda: _merge(connected=True),
    "merge-generic-v0": lambda: _merge_generic(connected=False),
    "merge-generic-v1": lambda: _merge_generic(connected=True),
    "roundabout-v0": lambda: _roundabout(connected=False),
    "roundabout-v1": lambda: _roundabout(connected=True),
}
"""The tasks that are reproduced, by highway-env's names."""


def original(name: str, batch: int = 1) -> RoadsConfig:
    """The configuration of one of highway-env's tasks, for a batch of episodes.

    Raises:
        ValueError: if the task is not reproduced.
    """
    if name not in ORIGINALS:
        raise ValueError(f"task must be one of {', '.join(ORIGINALS)}, got {name!r}")
    config = ORIGINALS[name]()
    return replace(config, scenes=config.scenes * batch)
