"""What is known of the tasks of highway-env (1.12): names, ranges and units of what they observe, actions, rate and length.

highway-env normalises most of its observations already, so the ranges are those of the normalised values, and the floors are the
resolutions of the sensors on that scale. Nothing here imports highway-env: it is asked of its environments.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from cavbench.driving.features import CONTROLS
from cavbench.driving.gym.entries import Entry

PACKAGE = "highway_env"
SECONDS = 40.0
"""Length of an episode of a task that has no limit, in s: that of highway-v0."""
RESOLUTIONS = {"x": 0.5, "y": 0.2, "vx": 0.3, "vy": 0.2}
"""Resolutions of the sensors, in m and m/s, as on the highway of cavbench."""
FLAGS = ("presence", "on_road")
ANGLE = {"heading": math.pi, "ang_off": math.pi}
FAR = {"x": 1000.0, "y": 1000.0, "vx": 80.0, "vy": 80.0, "long_off": 1000.0, "lat_off": 100.0}
"""The range of values that the task does not limit, in m and m/s: beyond its roads, and twice its largest speed."""
TRAFFIC: Mapping[str, float] = {"DISTANCE_WANTED": 10.0, "COMFORT_ACC_MAX": 3.0, "COMFORT_ACC_MIN": -5.0}
"""Constants of `IDMVehicle` as highway-env ships them. Making an intersection rewrites them for all tasks of the process."""


def is_task(env: Any) -> bool:
    """Whether an unwrapped environment is a task of highway-env, or derived from one."""
    return any(base.__module__.partition(".")[0] == PACKAGE for base in type(env).__mro__)


def restore_traffic() -> None:
    """Give the traffic its own constants back, which an intersection that was made before has changed.

    An intersection sets its own again in each reset.
    """
    behaviour = sys.modules.get(f"{PACKAGE}.vehicle.behavior")
    kinds = [] if behaviour is None else [behaviour.IDMVehicle]
    while kinds:
        kind = kinds.pop()
        kinds += kind.__subclasses__()
        for name, value in TRAFFIC.items():
            if kind is behaviour.IDMVehicle:  # type: ignore[union-attr]
                setattr(kind, name, value)
            elif name in vars(kind):
                delattr(kind, name)


def merged(default: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """A configuration with other values; mappings in it, such as `observation`, keep what is not given unless their type is."""
    found = dict(default)
    for name, value in given.items():
        own = default.get(name)
        inner = isinstance(value, Mapping) and isinstance(own, Mapping) and value.get("type") in (None, own.get("type"))
        found[name] = merged(own, value) if inner else value  # type: ignore[arg-type]
    return found


def rate(env: Any) -> float:
    """Decisions a second."""
    return float(env.config["policy_frequency"])


def limit(env: Any) -> int:
    """Decisions of an episode: what the task allows, or `SECONDS` if it has no limit."""
    seconds = env.config.get("duration", math.inf)
    decisions = (seconds if math.isfinite(seconds) else SECONDS) * rate(env)
    return max(1, round(decisions))


def reward(env: Any) -> tuple[float, ...]:
    """The rewards of the worst and the best step; the tasks normalise them but for parking, whose reward is minus a distance."""
    return (-1.0, 0.0) if _observes(env, "KinematicsGoalObservation") else (0.0, 1.0)


def actions(env: Any) -> tuple[str, ...]:
    """The names of the discrete actions, by number; empty if there are none."""
    found = getattr(env.action_type, "actions", None)
    return tuple(str(found[place]) for place in range(len(found))) if isinstance(found, Mapping) else ()


def controls(env: Any) -> tuple[str, ...]:
    """The names of the continuous actions; empty if there are none."""
    kind = env.action_type
    flags = [getattr(kind, name, None) for name in ("longitudinal", "lateral")]
    if None in flags or "Continuous" not in type(kind).__name__:
        return ()
    return tuple(name for name, there in zip(CONTROLS, flags, strict=True) if there)


def part(env: Any) -> str:
    """The part of an observation with several that is measured; empty if there are none."""
    if _observes(env, "AttributesObservation"):
        return "state"
    return "observation" if _observes(env, "KinematicsGoalObservation") else ""


def _observes(env: Any, kind: str) -> bool:
    return any(base.__name__ == kind for base in type(env.observation_type).__mro__)


def named(env: Any, entries: Sequence[Entry]) -> list[Entry]:
    """The entries of an observation with their names, ranges and resolutions, as far as its kind is known.

    Args:
        env: the task, after a reset.
        entries: as its space says.
    """
    kind = env.observation_type
    features = [str(name) for name in getattr(kind, "features", ())]
    if _observes(env, "KinematicsGoalObservation") and len(entries) % max(len(features), 1) == 0:
        return _goal(env, kind, features, entries)
    if _observes(env, "OccupancyGridObservation") and features and len(entries) % len(features) == 0:
        return _grid(kind, features, entries)
    if _observes(env, "KinematicObservation") and features and len(entries) % len(features) == 0:
        return _rows(env, kind, features, entries)
    if _observes(env, "LidarObservation") and len(entries) % 2 == 0:
        names = ("distance", "speed")
        return [
            replace(entry, name=f"{names[at % 2]}{at // 2}", column=names[at % 2]) for at, entry in enumerate(entries)
        ]
    if {entry.part for entry in entries} == set(LANE_KEEPING):
        return _lane_keeping(entries)
    if _observes(env, "TimeToCollisionObservation"):
        return [replace(entry, name=f"ttc{entry.name[1:]}", column="ttc") for entry in entries]
    return list(entries)


def _rows(env: Any, kind: Any, features: Sequence[str], entries: Sequence[Entry]) -> list[Entry]:
    """Rows of cars, the ego first: `presence0`, `x0` … What is measured of a car that is not there nobody can change."""
    width = len(features)
    flag = features.index("presence") if "presence" in features else None
    found = []
    for place, entry in enumerate(entries):
        name, row = features[place % width], place // width
        scale = _scale(kind, name) if kind.normalize else None
        ends = _ends(env, kind, name, scale, entry)
        found.append(
            replace(
                entry, name=f"{name}{row}", column=name, low=ends[0], high=ends[1], fixed=name in FLAGS,
                floor=RESOLUTIONS.get(name, 0.0) / (scale or 1.0),
                present=-1 if flag is None or name in FLAGS else row * width + flag,
            )
        )  # fmt: skip
    return found


def _scale(kind: Any, name: str) -> float | None:
    """What 1 is in m or m/s on the scale of a normalised value; None if the value is not normalised."""
    ends = (kind.features_range or {}).get(name)
    return None if ends is None else float(ends[1] - ends[0]) / 2


def _ends(env: Any, kind: Any, name: str, scale: float | None, entry: Entry) -> tuple[float, float]:
    """The range of a value of a row."""
    if name in FLAGS:
        return 0.0, 1.0
    if scale is not None and kind.clip:
        return -1.0, 1.0
    if name[:3] in ("cos", "sin"):
        return -1.0, 1.0
    if name in ANGLE:
        return -ANGLE[name], ANGLE[name]
    # Values in metres, and normalised ones that are not clipped, have no range that the task tells.
    far = FAR.get(name, math.inf) / (scale or 1.0)
    return (-far, far) if math.isfinite(far) else (entry.low, entry.high)


def _grid(kind: Any, features: Sequence[str], entries: Sequence[Entry]) -> list[Entry]:
    """Layers of a grid. What a cell holds is what was measured there, so nothing in it is fixed."""
    size = len(entries) // len(features)
    columns = kind.grid.shape[-1]
    found = []
    for place, entry in enumerate(entries):
        name = features[place // size]
        row, column = divmod(place % size, columns)
        low, high = (entry.low, entry.high) if entry.known else (0.0 if name in FLAGS else -1.0, 1.0)
        if not kind.clip and name not in FLAGS:
            low, high = entry.low, entry.high
        found.append(replace(entry, name=f"{name}{row}_{column}", column=name, low=low, high=high))
    return found


def _goal(env: Any, kind: Any, features: Sequence[str], entries: Sequence[Entry]) -> list[Entry]:
    """A measured state, the same again, and the goal, each divided by the scales of the task."""
    width, scales = len(features), np.asarray(kind.scales, np.float64)
    found = []
    for place, entry in enumerate(entries):
        name, scale = features[place % width], float(scales[place % width])
        ends = {"vx": _speed(env), "vy": _speed(env), "x": FIELD, "y": FIELD}.get(name, 1.0) / scale
        floor = RESOLUTIONS.get(name, 0.0) / scale
        shown = name if entry.part == "observation" else f"{entry.part}_{name}"
        found.append(replace(entry, name=shown, column=name, low=-ends, high=ends, floor=floor))
    return found


LANE_KEEPING = {
    "state": (100.0, 2 * math.pi, 100.0, 100.0),
    "derivative": (100.0, 100.0, 1000.0, 1000.0),
    "reference_state": (100.0, 2 * math.pi, 100.0, 100.0),
}
"""The parts that lane-keeping observes, each of lateral position, heading, lateral speed and yaw rate, in m, rad and s."""
MOTION = ("y", "heading", "vy", "yaw_rate")


def _lane_keeping(entries: Sequence[Entry]) -> list[Entry]:
    found = []
    for place, entry in enumerate(entries):
        end = LANE_KEEPING[entry.part][place % len(MOTION)]
        name = MOTION[place % len(MOTION)]
        shown = name if entry.part == "state" else f"{entry.part}_{name}"
        floor = RESOLUTIONS["y"] if shown == "y" else 0.0
        found.append(replace(entry, name=shown, column=name, low=-end, high=end, floor=floor))
    return found


FIELD = 100.0
"""The parking lot is within so many metres of its middle."""


def _speed(env: Any) -> float:
    """The largest speed of a car, in m/s."""
    return float(getattr(type(env.vehicle), "MAX_SPEED", 40.0))
