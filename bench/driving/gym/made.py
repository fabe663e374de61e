"""Finds and makes registered gymnasium environments. Nothing else of a stranger is imported than the module that an id names."""

from __future__ import annotations

import importlib
import inspect
import sys
import warnings
from collections.abc import Mapping
from functools import partial
from importlib import metadata
from typing import Any

import gymnasium
from gymnasium.envs.registration import EnvSpec

from cavbench.core import registry
from cavbench.driving.gym import highway_tasks
from cavbench.errors import UserError, message, reason, short
from cavbench.isolation.foreign import contained, harm

TRUSTED = ("gymnasium", highway_tasks.PACKAGE)
"""Packages whose environments are driven in the process of the command, like built-in worlds."""


def found(name: str) -> EnvSpec:
    """The registration of `NAME` or `MODULE:NAME`; the module is imported.

    Raises:
        UserError: if there is none; says what to type.
    """
    module, _, plain = name.rpartition(":")
    if module:
        _imported(module)
    elif plain not in gymnasium.registry and importlib.util.find_spec(highway_tasks.PACKAGE):
        _imported(highway_tasks.PACKAGE)
    if plain not in gymnasium.registry:
        known = sorted(gymnasium.registry)
        near = registry.unknown(f"environment {short(plain)!r}", plain, known).partition("; ")[2].partition("known:")[0]
        raise UserError(
            f"gymnasium has no environment {short(plain)!r}; {near}an id of another package names its module: "
            f"world.id=my_package:{plain or 'MyEnv-v0'}"
        )
    return gymnasium.registry[plain]


def _imported(module: str) -> None:
    top = module.partition(".")[0]
    try:
        there = importlib.util.find_spec(top) is not None
    except (ValueError, ImportError):
        there = False
    if not there:
        raise UserError(f"there is no module {short(module)!r}, which world.id names: install it, or correct the id")
    if (
        top not in TRUSTED
        and module not in sys.modules
        and (why := harm(partial(importlib.import_module, module), stays=True))
    ):
        raise UserError(f"the module {module!r}, which world.id names, cannot be imported: its import {why}")
    try:
        with contained(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            importlib.import_module(module)
    # A user's module may raise anything.
    except Exception as error:
        raise UserError(f"the module {module!r}, which world.id names, cannot be imported: {reason(error)}") from error


def stranger(name: str) -> str:
    """The module that an id makes us import, if it is none of `TRUSTED`; otherwise empty."""
    module, _, _ = name.rpartition(":")
    return "" if not module or module.partition(".")[0] in TRUSTED else module


def home(spec: EnvSpec) -> str:
    """The module that defines an environment.

    Raises:
        UserError: if it is no module that another process can import.
    """
    entry = spec.entry_point
    module = entry.partition(":")[0] if isinstance(entry, str) else getattr(entry, "__module__", "")
    if not module or module == "__main__" or not importlib.util.find_spec(module.partition(".")[0]):
        raise UserError(
            f"{spec.id} is registered by this script or notebook only: give cavbench.score a function that makes it, "
            f"world=lambda: gymnasium.make({spec.id!r}), or register it in a module and write world.id=module:{spec.id}"
        )
    return str(module)


def distribution(module: str) -> str:
    """The distribution that ships a module; empty if none does."""
    top = module.partition(".")[0]
    if top == highway_tasks.PACKAGE:
        return "highway-env"
    return top if top == "gymnasium" else next(iter(metadata.packages_distributions().get(top, ())), "")


def made(spec: EnvSpec, given: Mapping[str, Any]) -> gymnasium.Env[Any, Any]:
    """A new environment with these values: keys of its configuration in highway-env, otherwise its arguments.

    Raises:
        UserError: if it does not know one of them, or cannot be made.
    """
    try:
        with contained(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            kind = (
                gymnasium.envs.registration.load_env_creator(spec.entry_point)
                if isinstance(spec.entry_point, str)
                else spec.entry_point
            )
            highway_tasks.restore_traffic()
            return gymnasium.make(spec, disable_env_checker=True, **_arguments(spec, kind, given))
    except UserError:
        raise
    # The environment may raise anything.
    except Exception as error:
        raise UserError(f"{spec.id} cannot be made: {message(error) or type(error).__name__}") from error


def _arguments(spec: EnvSpec, kind: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments of `gymnasium.make`.

    Raises:
        UserError: if the environment does not know one of them.
    """
    if hasattr(kind, "default_config"):
        default = highway_tasks.merged(kind.default_config(), spec.kwargs.get("config") or {})
        if strange := [name for name in given if name not in default]:
            raise UserError(
                registry.unknown(f"key {strange[0]!r} of the configuration of {spec.id}", strange[0], sorted(default))
            )
        return {"config": highway_tasks.merged(default, given)} if given else {}
    parameters = inspect.signature(kind).parameters
    if not any(one.kind is one.VAR_KEYWORD for one in parameters.values()):
        known = [name for name in parameters if name not in ("self", "render_mode")]
        if strange := [name for name in given if name not in known]:
            raise UserError(registry.unknown(f"argument {strange[0]!r} of {spec.id}", strange[0], known))
    return dict(given)
