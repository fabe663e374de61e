"""What a `GymWorld` declares of its environment, compared with the environment."""

from __future__ import annotations

from collections import UserDict
from math import prod
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from cavbench.core import registry
from cavbench.driving import ActionType
from cavbench.driving.gym.declaration import Declaration
from cavbench.errors import UserError, short
from cavbench.identity.fingerprint import canonical
from cavbench.isolation.foreign import contained
from cavbench.scenarios import Axes, Cell, Value

# Not among the data that no unit may change (`cavbench.isolation.framework.Snapshot`): a world is asked when it is needed.
_asked: UserDict[tuple[type, str], spaces.Box | None] = UserDict()
"""What environments that were asked observe, by class and parameters of the world."""


def native_shape(world: Declaration) -> tuple[int, ...]:
    """Shape of the array that the environment itself returns.

    It is `world.shape` or, if that is empty, what an environment says that is made once for it. A world whose environment cannot
    be made without a cell of its grid has a flat one.
    """
    if world.shape:
        return world.shape
    space = _space(world)
    return (len(world.features.names),) if space is None else space.shape


def native_limits(world: Declaration) -> tuple[tuple[float, float], ...]:
    """The lowest and the highest value of each entry in the space of an environment's observation.

    Empty if `world.shape` is given, so that none is asked, or none can be made without a cell of its grid.
    """
    space = None if world.shape else _space(world)
    if space is None:
        return ()
    return tuple(zip(space.low.reshape(-1).tolist(), space.high.reshape(-1).tolist(), strict=True))


def check(world: Declaration, env: gymnasium.Env[Any, Any], action_type: ActionType) -> None:
    """Refuse an environment whose spaces are not those of the world.

    Raises:
        UserError: says what differs.
    """
    name, count, space = world.label, len(world.features.names), env.observation_space
    if not space.is_np_flattenable or spaces.flatdim(space) != count:
        raise UserError(f"{name} declares {count} features, its environment observes {short(str(space))}")
    if isinstance(space, spaces.Box) and space.shape != (shape := native_shape(world)):
        raise UserError(
            f"the environment of {name} observes arrays {list(space.shape)}, not {list(shape)}: "
            f"write shape: ClassVar[tuple[int, ...]] = {space.shape} in the class"
        )
    action = env.action_space
    if action_type == "discrete" and not (isinstance(action, spaces.Discrete) and action.n == len(world.actions)):
        hint = (
            ": continuous policies fit it (victim.actions or action_type=continuous)"
            if isinstance(action, spaces.Box)
            else ""
        )
        raise UserError(f"{name} names {len(world.actions)} discrete actions, its environment takes {action}{hint}")
    if action_type == "continuous":
        _check_controls(world, name, action)


def _check_controls(world: Declaration, name: str, action: spaces.Space[Any]) -> None:
    listed = ", ".join(world.controls)
    if not isinstance(action, spaces.Box):
        raise UserError(
            f"the environment of {name} takes {short(str(action))}, a continuous policy has {len(world.controls)} controls"
        )
    if prod(action.shape) != len(world.controls):
        found = tuple(f"control{place}" for place in range(prod(action.shape)))
        raise UserError(
            f"{name} has {len(world.controls)} controls ({listed}), its environment takes {action}; for its {len(found)} numbers "
            f"write controls: ClassVar[tuple[str, ...]] = {found} in the class"
        )
    if not (np.isfinite(action.low).all() and np.isfinite(action.high).all()):
        raise UserError(
            f"the environment of {name} takes {action}, without a lowest and a highest value: wrap it in RescaleAction"
        )


def _space(world: Declaration) -> spaces.Box | None:
    """The space of an environment's observation; None if none can be made, or it is no Box of the declared size."""
    key = (type(world), canonical(world))
    if key not in _asked:
        _asked[key] = _ask(world)
    return _asked[key]


def _ask(world: Declaration) -> spaces.Box | None:
    try:
        with contained():
            env = world.environment(_any_cell(world))
            space = env.observation_space
            env.close()
    # The environment of a plug-in may raise anything; it is made again, and then heard, when it is driven.
    except Exception:
        return None
    return space if isinstance(space, spaces.Box) and prod(space.shape) == len(world.features.names) else None


def _any_cell(world: Declaration) -> Cell:
    """The first cell of the world's grid or, if that is not installed, one of values that the axes allow."""
    if world.own_grid() is not None or world.grid in registry.entries(registry.GRIDS):
        return registry.grid_of(world).cells()[0]
    return _allowed(world.axes)


def _allowed(axes: Axes) -> Cell:
    found: dict[str, Value] = {}
    for name, axis in axes.items():
        tried = (axis.default, *axis.choices, axis.low, axis.high, axis.above + 1, 1, 0)
        for value in tried:
            try:
                found[name] = axis.checked(value)  # type: ignore[arg-type]
                break
            except (ValueError, OverflowError):
                continue
    return axes.cell(**found)
