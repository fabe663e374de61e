"""What is known of an environment without declaring it: gymnasium's own tasks, and those of highway-env."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gymnasium

from cavbench.driving.gym import highway_tasks
from cavbench.driving.gym.declaration import Ending
from cavbench.driving.gym.entries import Entry

ONLY_ARRIVING = (100.0, 101.0)
"""A range of rewards above that of every step: no step is worth anything, arriving is worth all steps that are left."""


@dataclass(frozen=True, kw_only=True)
class Known:
    """What is known of an environment.

    Args:
        entries: names and ranges of the entries of its observation, if they are known better than its space says.
        terminated: what it means that it terminates an episode.
        reward: the rewards of the worst and of the best step; empty if a reward is a share already.
        max_steps: decisions of an episode; 0 if it has no limit.
        hz: decisions a second.
        actions: names of its discrete actions; empty if it has none for them.
        controls: names of its continuous actions; empty if it has none for them.
        part: the part of its observation that is attacked; empty if there are no parts, or nothing is known.
    """

    entries: Callable[[Sequence[Entry]], list[Entry]] = list
    terminated: Ending = "unknown"
    reward: tuple[float, ...] = ()
    max_steps: int = 0
    hz: float = 1.0
    actions: tuple[str, ...] = ()
    controls: tuple[str, ...] = ()
    part: str = ""


def _named(*rows: tuple[str, str, float], fixed: Sequence[str] = ()) -> Callable[[Sequence[Entry]], list[Entry]]:
    """Names, units and the range of what has none in the space: of each entry its name, its unit and the end of its range."""

    def of(entries: Sequence[Entry]) -> list[Entry]:
        # A wrapper may have changed the observation.
        if len(entries) != len(rows):
            return list(entries)
        found = []
        for one, (name, unit, end) in zip(entries, rows, strict=True):
            low, high = (one.low, one.high) if one.known else (-end, end)
            found.append(replace(one, name=name, unit=unit, fixed=name in fixed, low=low, high=high))
        return found

    return of


CART = (("x", "m", 4.8), ("vx", "m/s", 4.0), ("angle", "rad", 0.42), ("spin", "rad/s", 4.0))
CAR = (("x", "", 1.0), ("v", "", 1.0))
PENDULUM = (("cos", "", 1.0), ("sin", "", 1.0), ("spin", "rad/s", 8.0))
ACROBOT = (
    ("cos1", "", 1.0),
    ("sin1", "", 1.0),
    ("cos2", "", 1.0),
    ("sin2", "", 1.0),
    ("spin1", "rad/s", 12.6),
    ("spin2", "rad/s", 28.3),
)
LANDER = tuple((name, "", 1.0) for name in ("x", "y", "vx", "vy", "angle", "spin", "left_leg", "right_leg"))
GYMNASIUM: dict[str, Known] = {
    "CartPole": Known(entries=_named(*CART), terminated="failure", actions=("LEFT", "RIGHT")),
    "MountainCar": Known(
        entries=_named(*CAR), terminated="success", reward=(-1.0, 0.0), actions=("LEFT", "NOTHING", "RIGHT")
    ),
    "MountainCarContinuous": Known(
        entries=_named(*CAR), terminated="success", reward=ONLY_ARRIVING, controls=("push",)
    ),
    "Pendulum": Known(entries=_named(*PENDULUM), terminated="failure", reward=(-16.2736, 0.0), controls=("torque",)),
    "Acrobot": Known(
        entries=_named(*ACROBOT), terminated="success", reward=(-1.0, 0.0), actions=("BACKWARD", "NOTHING", "FORWARD")
    ),
    "LunarLander": Known(
        entries=_named(*LANDER, fixed=("left_leg", "right_leg")), terminated="reward", reward=ONLY_ARRIVING,
        actions=("NOTHING", "LEFT", "MAIN", "RIGHT"), controls=("main", "side"),
    ),
}  # fmt: skip
"""gymnasium's tasks by their names without a version, from its documentation of each (gymnasium 1.4)."""


def known_of(env: gymnasium.Env[Any, Any]) -> Known:
    """What is known of an environment that was made from a registered name."""
    inner = env.unwrapped
    spec = inner.spec or env.spec
    found = Known()
    if highway_tasks.is_task(inner):
        actions = highway_tasks.actions(inner)
        names = highway_tasks.controls(inner)
        found = Known(
            entries=lambda entries: highway_tasks.named(inner, entries),
            reward=highway_tasks.reward(inner),
            # highway-env tells `crashed` in info.
            max_steps=highway_tasks.limit(inner),
            hz=highway_tasks.rate(inner),
            actions=actions,
            controls=names,
            part=highway_tasks.part(inner),
        )
    elif spec is not None and type(inner).__module__.partition(".")[0] == "gymnasium":
        found = GYMNASIUM.get(spec.name, found)
        if spec.name.startswith("LunarLander"):
            found = GYMNASIUM["LunarLander"]
    rate = inner.metadata.get("render_fps")
    return replace(found, hz=float(rate)) if rate and found.hz == 1.0 and not highway_tasks.is_task(inner) else found
