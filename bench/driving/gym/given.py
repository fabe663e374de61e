"""A world of a gymnasium environment that was given from Python: an id, an environment, or a function that makes one."""

from __future__ import annotations

import copy
import functools
import pickle
import re
import secrets
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import gymnasium

from cavbench.driving.gym import highway_tasks, made
from cavbench.driving.gym.environment import DrivingEnv
from cavbench.driving.gym.registered import RegisteredWorld
from cavbench.errors import UserError, reason, short
from cavbench.identity.bytecode import code_of
from cavbench.identity.content import content
from cavbench.identity.fingerprint import digest
from cavbench.isolation.foreign import contained
from cavbench.scenarios import Cell

Maker = Callable[..., gymnasium.Env[Any, Any]]


@dataclass(frozen=True, kw_only=True)
class GivenWorld(RegisteredWorld):
    """A world of environments that a function makes; made by `world`. Its records cannot be replayed: no package ships it.

    Args:
        id: what tables call it.
    """

    id: str = ""

    def _spec(self) -> Any:
        return SimpleNamespace(id=self.id)

    def environment(self, cell: Cell) -> gymnasium.Env[Any, Any]:
        """A new environment, made with the values of the cell."""
        values = {name: cell[name] for name in (self.axes.given_parameter or ())}
        try:
            with contained():
                highway_tasks.restore_traffic()
                env = self._maker(**{**(self.config.plain() if self.config else {}), **values})
        # The user's function may raise anything.
        except UserError:
            raise
        except Exception as error:
            raise UserError(f"the environment of world={self.id} cannot be made: {reason(error)}") from error
        if not isinstance(env, gymnasium.Env):
            raise UserError(
                f"world= takes a function that returns a gymnasium environment, {self.id} returned a {type(env).__name__}"
            )
        return env

    @property
    def source(self) -> str:
        return f"the function {self.id}"

    @property
    def _maker(self) -> Maker:
        maker: Maker = vars(self)["maker"]
        return maker

    @property
    def content(self) -> str:
        """Hash of all that it is made of."""
        return str(vars(self)["digest"])

    def _home(self) -> str:
        return str(vars(self)["module"])

    def modules(self) -> tuple[str, ...]:  # type: ignore[override]
        """Its own module: the rest is in `content`."""
        return (type(self).__module__,)


@dataclass(frozen=True)
class Copies:
    """Makes copies of an environment.

    Args:
        env: a copy of the user's, which nobody steps.
    """

    env: gymnasium.Env[Any, Any]

    def __call__(self, **values: Any) -> gymnasium.Env[Any, Any]:
        env = copy.deepcopy(self.env)
        if values:
            inner: Any = env.unwrapped
            if not highway_tasks.is_task(inner):
                raise UserError(
                    "config and axes change an environment that is made for them: give its id, or a function that takes "
                    f"{', '.join(values)}"
                )
            if strange := [name for name in values if name not in inner.config]:
                raise UserError(f"the configuration of the environment has no key {strange[0]!r}")
            inner.configure(highway_tasks.merged(inner.config, values))
        return env


def world(given: Any, **parameters: Any) -> RegisteredWorld:
    """A world of a gymnasium environment, for `cavbench.score(victim, attack, world=...)`, which makes it itself if need be.

        world = cavbench.gym.world("CartPole-v1", features={"vx": [-4, 4], "spin": [-4, 4]})
        world = cavbench.gym.world(lambda: MyEnv(), max_steps=200, terminated="failure")

    Args:
        given: an id; an environment, with its wrappers, which is copied for each episode; or a function that makes one. The
            function gets `config` and the values of the cell on `axes` by name.
        parameters: those of the world `gym` (`bench list gym`).

    Raises:
        UserError: if it is none of these, or lacks what the world needs; says what to type.
    """
    try:
        return _of_anything(given, parameters)
    except UserError as error:
        # Messages name the options of the command line.
        option = re.search(r"\bworld\.([a-z_]+)\b", str(error))
        typed = f"; in Python: world=cavbench.gym.world(env, {option[1]}=...)" if option and option[1] != "id" else ""
        raise UserError(f"{error}{typed}") from None


def _of_anything(given: Any, parameters: Mapping[str, Any]) -> RegisteredWorld:
    if isinstance(given, str):
        return _of_id(given, parameters)
    if isinstance(given, gymnasium.Env):
        if isinstance(given.unwrapped, DrivingEnv):
            raise UserError(
                "this environment is a world of cavbench already: give that world, world=env.unwrapped.world"
            )
        return _made(_copies(given), _name(given), type(given.unwrapped), _of_object(given), parameters)
    if hasattr(given, "venv") or hasattr(given, "num_envs") or hasattr(given, "envs"):
        raise UserError(
            f"a {type(given).__name__} holds several environments: give one of them, or a function that makes one"
        )
    if callable(given):
        return _made(
            given, getattr(given, "__name__", type(given).__name__).strip("<>"), given, _of_function(given), parameters
        )
    raise UserError(
        f"world takes a name, a World, the id of a gymnasium environment, such an environment, or a function that makes one, got "
        f"{short(type(given).__name__)}"
    )


def _of_id(name: str, parameters: Mapping[str, Any]) -> RegisteredWorld:
    spec = made.found(name)
    if isinstance(spec.entry_point, str) and (":" in name or made.home(spec).partition(".")[0] in made.TRUSTED):
        try:
            return RegisteredWorld(id=name, **parameters)
        except (ValueError, TypeError) as error:
            raise UserError(str(error)) from error
    # It is registered in this process only, so no other can make it by its name.
    maker = functools.partial(gymnasium.make, spec, disable_env_checker=True)
    return _made(
        maker, spec.id, spec.entry_point, digest([str(spec.kwargs), code_of(_class(spec.entry_point))]), parameters
    )


def _class(entry: Any) -> Any:
    return gymnasium.envs.registration.load_env_creator(entry) if isinstance(entry, str) else entry


def _made(maker: Any, name: str, source: Any, identity: str, parameters: Mapping[str, Any]) -> GivenWorld:
    world = object.__new__(GivenWorld)
    module = getattr(_class(source), "__module__", "") or ""
    for key, value in {"maker": maker, "digest": identity, "module": module}.items():
        object.__setattr__(world, key, value)
    try:
        world.__init__(**{"id": name, **parameters})  # type: ignore[misc]
    except (ValueError, TypeError) as error:
        raise UserError(str(error)) from error
    return world


def _copies(env: gymnasium.Env[Any, Any]) -> Copies:
    try:
        with contained():
            return Copies(copy.deepcopy(env))
    # The environment may hold anything.
    except Exception as error:
        raise UserError(
            f"{_name(env)} cannot be copied for each episode ({reason(error)}): give a function that makes it, world=lambda: …"
        ) from error


def _name(env: gymnasium.Env[Any, Any]) -> str:
    spec = env.spec
    return spec.id if spec is not None else type(env.unwrapped).__name__


def _of_object(env: gymnasium.Env[Any, Any]) -> str:
    """A hash of an environment: of the code of its classes, and of what it holds. What cannot be hashed is like no other."""
    chain: list[Any] = []
    inner: Any = env
    while isinstance(inner, gymnasium.Wrapper):
        chain.append(type(inner))
        inner = inner.env
    try:
        held = pickle.dumps(env)
    # Pickling calls code of the object, which may raise anything.
    except Exception:
        held = secrets.token_bytes(16)
    return digest([code_of(*chain, type(inner)), content(held)])


def _of_function(maker: Any) -> str:
    """A hash of a function: its code, and what it remembers."""
    if isinstance(maker, functools.partial):
        return digest([_of_function(maker.func), content([list(maker.args), maker.keywords])])
    return digest([code_of(maker), content(maker)])
