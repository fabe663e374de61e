"""highway-env's own tasks as it registers them: each with its default configuration, for comparisons with it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from cavbench.envs.roads import exit as leave
from cavbench.envs.roads import intersection, racetrack, roundabout, two_way, u_turn
from cavbench.envs.roads.config import RoadsConfig, Scene, TaskKind
from cavbench.envs.roads.merge import CLASSIC_END, classic, generic, spots
from cavbench.envs.roads.network import record
from cavbench.envs.roads.state import ViewKind


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
        scenes=(Scene(road=road, traffic=4, capacity=5, goal=roundabout.STRAIGHT),),
        duration=11.0,
        target_speeds=(0.0, 8.0, 16.0),
        low=(-100.0, -100.0, -15.0, -15.0),
        high=(100.0, 100.0, 15.0, 15.0),
        relative=False,
    )


def _intersection(*, connected: bool) -> RoadsConfig:
    net = intersection.intersection(connected=connected)
    road = record(net, spots=intersection.spots(net), destinations=intersection.DESTINATIONS)
    return RoadsConfig(
        task=TaskKind.INTERSECTION,
        scenes=(Scene(road=road, traffic=10, capacity=32, arrivals=0.6, goal=1),),
        duration=13.0,
        target_speeds=(0.0, 4.5, 9.0),
        reward_speed_range=(7.0, 9.0),
        actions=(4, 1, 3),
        idm=(6.0, 3.0, 7.0),
        regulated=True,
        features=("presence", "x", "y", "vx", "vy", "cos_h", "sin_h"),
        low=(-100.0, -100.0, -20.0, -20.0),
        high=(100.0, 100.0, 20.0, 20.0),
        relative=False,
        observed_vehicles=15,
    )


def _sliding_intersection() -> RoadsConfig:
    return replace(
        _intersection(connected=False),
        action_type="continuous",
        slides=True,
        steering_limit=math.pi / 3,
        features=("presence", "x", "y", "vx", "vy", "long_off", "lat_off", "ang_off"),
        observed_vehicles=5,
    )


def _exit(*, connected: bool) -> RoadsConfig:
    net = leave.exit_road(lanes=6, connected=connected)
    spots = leave.spots(net)
    road = record(net, spots=spots, destinations=leave.DESTINATIONS, factor=leave.spacing_factor(6))
    return RoadsConfig(
        task=TaskKind.EXIT,
        scenes=(Scene(road=road, traffic=20, density=1.5, capacity=21),),
        simulation_frequency=5,
        duration=18.0,
        target_speeds=(18.0, 24.0, 30.0),
        view=ViewKind.EXIT_ROWS,
        features=("presence", "x", "y", "vx", "vy", "cos_h", "sin_h"),
        clipped=False,
        obstacles=False,
        observed_vehicles=15,
    )


def _two_way() -> RoadsConfig:
    net = two_way.two_way()
    road = record(net, spots=two_way.spots(net))
    return RoadsConfig(
        task=TaskKind.TWO_WAY,
        scenes=(Scene(road=road, traffic=3, oncoming=2, capacity=6),),
        max_steps=15,
        view=ViewKind.TIMES,
        horizon=5.0,
    )


def _u_turn(*, connected: bool) -> RoadsConfig:
    net = u_turn.u_turn(connected=connected)
    road = record(net, spots=u_turn.spots(net), destinations=u_turn.DESTINATIONS)
    return RoadsConfig(
        task=TaskKind.U_TURN,
        scenes=(Scene(road=road, traffic=6, capacity=7),),
        duration=10.0,
        target_speeds=(8.0, 16.0, 24.0),
        reward_speed_range=(8.0, 24.0),
        view=ViewKind.TIMES,
        horizon=16.0,
    )


def _racetrack(*, connected: bool) -> RoadsConfig:
    net = racetrack.racetrack(connected=connected)
    road = record(net, spots=racetrack.spots(net))
    return RoadsConfig(
        task=TaskKind.RACETRACK,
        scenes=(Scene(road=road, traffic=1, capacity=2),),
        policy_frequency=5,
        duration=300.0,
        action_type="continuous",
        view=ViewKind.OCCUPANCY,
        offroad_terminal=True,
    )


ORIGINALS: dict[str, Callable[[], RoadsConfig]] = {
    "merge-v0": lambda: _merge(connected=False),
    "merge-v1": lambda: _merge(connected=True),
    "merge-generic-v0": lambda: _merge_generic(connected=False),
    "merge-generic-v1": lambda: _merge_generic(connected=True),
    "roundabout-v0": lambda: _roundabout(connected=False),
    "roundabout-v1": lambda: _roundabout(connected=True),
    "intersection-v0": lambda: _intersection(connected=False),
    "intersection-v1": _sliding_intersection,
    "intersection-v2": lambda: _intersection(connected=True),
    "exit-v0": lambda: _exit(connected=False),
    "exit-v1": lambda: _exit(connected=True),
    "two-way-v0": _two_way,
    "u-turn-v0": lambda: _u_turn(connected=False),
    "u-turn-v1": lambda: _u_turn(connected=True),
    "racetrack-v0": lambda: _racetrack(connected=False),
    "racetrack-v1": lambda: _racetrack(connected=True),
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
