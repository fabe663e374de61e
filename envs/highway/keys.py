"""highway-env's own configuration keys, as its users write them, read into the fields of `HighwayConfig`."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

from cavbench.envs.highway.config import STANDARD_FEATURES
from cavbench.errors import short

LONGEST = 100_000
"""Most decisions in an episode."""
AXES = {"lanes_count": "lanes", "vehicles_density": "density"}
"""Keys that are axes of the world, with their names there."""
DRAWN = ("screen_width", "screen_height", "centering_position", "scaling", "show_trajectories", "render_agent")
DRAWING = (*DRAWN, "offscreen_rendering", "real_time_rendering")
"""Keys that say how an episode is drawn: ignored."""
FIXED: Mapping[str, Any] = {
    "other_vehicles_type": "highway_env.vehicle.behavior.IDMVehicle",
    "controlled_vehicles": 1,
    "lane_change_reward": 0,
    "manual_control": False,
    "neighbour_vehicles_connected_lanes": False,
}
OBSERVED: Mapping[str, Any] = {
    "type": "Kinematics",
    "features": ["presence", *STANDARD_FEATURES.names],
    "absolute": False,
    "order": "sorted",
    "normalize": True,
    "clip": True,
    "see_behind": False,
    "observe_intentions": False,
    "include_obstacles": True,
}
ACTED: Mapping[str, Any] = {
    "longitudinal": True,
    "lateral": True,
    "acceleration_range": None,
    "steering_range": None,
    "speed_range": None,
    "dynamical": False,
    "clip": True,
}
"""Keys of the task, of its observation and of its actions that the engine knows with highway-env's default only."""
ACTIONS = ("DiscreteMetaAction", "ContinuousAction")


def whole(key: str, value: Any) -> int:
    """A whole number.

    Raises:
        ValueError: if it is none.
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or value != value // 1:
        raise ValueError(f"{key} must be a whole number, got {short(repr(value))}")
    return int(value)


def number(key: str, value: Any) -> float:
    """A number.

    Raises:
        ValueError: if it is none.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{key} must be a number, got {short(repr(value))}")
    return float(value)


def flag(key: str, value: Any) -> bool:
    """True or false.

    Raises:
        ValueError: if it is neither.
    """
    if not isinstance(value, bool):
        raise ValueError(f"{key} must be true or false, got {short(repr(value))}")
    return value


def numbers(key: str, value: Any) -> tuple[float, ...]:
    """A list of numbers.

    Raises:
        ValueError: if it is none.
    """
    if not isinstance(value, list | tuple):
        raise ValueError(f"{key} must be a list of numbers, got {short(repr(value))}")
    return tuple(number(key, one) for one in value)


READ: Mapping[str, tuple[str, Callable[[str, Any], Any]]] = {
    "vehicles_count": ("vehicles", whole),
    "simulation_frequency": ("simulation_frequency", whole),
    "policy_frequency": ("policy_frequency", whole),
    "ego_spacing": ("ego_spacing", number),
    "collision_reward": ("collision_reward", number),
    "right_lane_reward": ("right_lane_reward", number),
    "high_speed_reward": ("high_speed_reward", number),
    "reward_speed_range": ("reward_speed_range", numbers),
    "normalize_reward": ("normalize_reward", flag),
    "offroad_terminal": ("offroad_terminal", flag),
}
"""highway-env's name of a value: the field of `HighwayConfig`, and how it is read."""
KNOWN = (*READ, "duration", "initial_lane_id", "observation", "action")


def parsed(given: Mapping[str, Any] | str) -> dict[str, Any]:
    """highway-env's configuration, given as a mapping or as JSON.

    Raises:
        ValueError: if it is neither.
    """
    found = given
    if isinstance(given, str):
        try:
            found = json.loads(given or "{}")
        except (ValueError, RecursionError):
            found = given
    if not isinstance(found, Mapping):
        raise ValueError(
            f"config takes highway-env's keys, as in config={{vehicles_count: 30, duration: 60}}, got {short(repr(given))}"
        )
    return {str(key): value for key, value in found.items()}


def fields_of(given: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of `HighwayConfig` that a configuration of highway-env sets; `duration` in seconds.

    Args:
        given: the configuration.
        own: highway-env's names and values of the task's axes.

    Raises:
        ValueError: names the first key or value that the engine does not know, and those that it knows.
    """
    found: dict[str, Any] = {}
    for key, value in given.items():
        if key in DRAWING:
            continue
        if key in AXES:
            if value != own[key]:
                raise ValueError(
                    f"{key} is an axis of this world: leave it out of config, and write {AXES[key]}={value}"
                )
        elif key in FIXED:
            _only(key, value, FIXED)
        elif key in READ:
            name, read = READ[key]
            found[name] = read(f"config.{key}", value)
        elif key == "duration":
            found["duration"] = number("config.duration", value)
        elif key == "initial_lane_id":
            found["start_lane"] = None if value is None else whole("config.initial_lane_id", value)
        elif key in ("observation", "action"):
            found |= _observation(value) if key == "observation" else _action(value)
        else:
            raise ValueError(
                f"config has the key {short(key)!r}, which the engine does not know; known: {', '.join(KNOWN)}"
            )
    return found


def decisions(duration: float, frequency: int) -> int:
    """Decisions in an episode of so many seconds. highway-env adds up 1 / frequency, so there may be one more than expected.

    Raises:
        ValueError: if there are too many, or none.
    """
    if not 0 < duration <= LONGEST / frequency:
        raise ValueError(f"config.duration must be above 0 and at most {LONGEST / frequency:g} s, got {duration:g}")
    time, count = 0.0, 0
    while time < duration:
        time, count = time + 1 / frequency, count + 1
    return count


def _observation(given: Any) -> dict[str, Any]:
    """The fields that `observation` sets."""
    found: dict[str, Any] = {}
    for key, value in _inner("observation", given, (*OBSERVED, "vehicles_count", "features_range")).items():
        where = f"observation.{key}"
        if key == "vehicles_count":
            found["observed_vehicles"] = whole(f"config.{where}", value)
        elif key == "features_range":
            if value is not None:
                found["ranges"] = _ranges(value)
        elif key != "features" or value is not None:
            _only(where, list(value) if isinstance(value, tuple) else value, {where: OBSERVED[key]})
    return found


def _ranges(given: Any) -> dict[str, tuple[float, float]]:
    """The range of every feature: highway-env leaves those that are not named as they are, in metres."""
    names = STANDARD_FEATURES.names
    found = {}
    for name, value in _inner("observation.features_range", given, ("presence", *names)).items():
        low_high = numbers(f"config.observation.features_range.{name}", value)
        if len(low_high) != 2:
            raise ValueError(f"config.observation.features_range.{name} must be [low, high], got {list(low_high)}")
        found[name] = (low_high[0], low_high[1])
    if missing := [name for name in names if name not in found]:
        raise ValueError(
            f"config.observation.features_range must give all of {', '.join(names)}, {missing[0]} is missing: highway-env would "
            "not normalise it"
        )
    if "presence" in found:
        raise ValueError("config.observation.features_range must leave out presence, which is 0 or 1")
    return found


def _action(given: Any) -> dict[str, Any]:
    """The fields that `action` sets. The victim's actions decide between the types."""
    found: dict[str, Any] = {}
    for key, value in _inner("action", given, ("type", "target_speeds", *ACTED)).items():
        if key == "type":
            if value not in ACTIONS:
                raise ValueError(f"config.action.type must be one of {', '.join(ACTIONS)}, got {short(repr(value))}")
        elif key == "target_speeds":
            if value is not None:
                found["target_speeds"] = numbers("config.action.target_speeds", value)
        else:
            _only(f"action.{key}", value, {f"action.{key}": ACTED[key]})
    return found


def _inner(key: str, given: Any, known: tuple[str, ...]) -> Mapping[str, Any]:
    if not isinstance(given, Mapping):
        raise ValueError(f"config.{key} takes keys and values, got {short(repr(given))}")
    if strange := [str(name) for name in given if name not in known]:
        raise ValueError(
            f"config.{key} has the key {short(strange[0])!r}, which the engine does not know; known: {', '.join(known)}"
        )
    return given


def _only(key: str, value: Any, known: Mapping[str, Any]) -> None:
    """Refuse a value other than the one that the engine knows."""
    if value != known[key] or isinstance(value, bool) != isinstance(known[key], bool):
        raise ValueError(f"config.{key} is {json.dumps(known[key])} in the engine, got {short(repr(value))}")
