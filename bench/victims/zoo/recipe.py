"""Recipes: everything that decides what a training makes, except its seed. An entry of the zoo is named after one.

Only parameters that differ from their default count, so a new parameter with a default changes no recipe. The code counts by
`training`, a number on the class of a victim or defence that its author raises when the training makes something else.

Two parameters have a meaning of their own, where a component has them. `trained` chooses a training seed of the zoo, and is no
part of the recipe of what that component trains. `trained_in` names the world of the training where it is not the default.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bench.errors import UserError
from bench.plugins import registry
from bench.plugins.contracts import Component, Defense, Victim, World
from bench.plugins.fingerprint import digest
from bench.plugins.parameters import Parameter, parameters
from bench.plugins.registry import GROUPS, Kind

DIGITS = 8
"""Of a digest in the name of a folder."""
MEANT_OTHERWISE = ("null", "true", "false")
"""Texts that the command line reads as something else."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """A component, as far as a training depends on it.

    Args:
        kind: victim, defense or world.
        name: on the command line; the name of its class if it is not installed.
        source: top-level package and class, `bench.DQN`: stays when a class moves within its package.
        module: of the class.
        libraries: distributions that compute for it.
        training: version of its training.
        parameters: all of them.
        changed: those that differ from their default.
    """

    kind: Kind
    name: str
    source: str
    module: str
    libraries: tuple[str, ...]
    training: int
    parameters: Mapping[str, Any]
    changed: Mapping[str, Any]

    @classmethod
    def of(cls, kind: Kind, component: Component, *, without: str = "") -> Part:
        """A component's part, leaving out the parameter `without`."""
        own = type(component)
        owned = {name: each for name, each in parameters(own).items() if name != without}
        values = {name: _value(component, each) for name, each in owned.items()}
        return cls(
            kind=kind,
            name=_registered(kind, own),
            source=f"{own.__module__.partition('.')[0]}.{own.__qualname__}",
            module=own.__module__,
            libraries=own.libraries,
            training=own.training,
            parameters=values,
            changed={name: value for name, value in values.items() if _differs(value, owned[name])},
        )

    @property
    def options(self) -> list[str]:
        """Its parameters that differ from their default, as on the command line: `victim.hidden=64`."""
        return [f"{self.kind}.{name}={_text(value)}" for name, value in self.changed.items()]

    @property
    def identity(self) -> dict[str, object]:
        """What goes into the digest."""
        return {"class": self.source, "training": self.training, "changed": self.changed}

    def described(self) -> dict[str, object]:
        """What the card says of it."""
        named = {"name": self.name, "class": self.source, "training": self.training}
        return {**named, "parameters": self.parameters, "changed": self.changed}


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """What decides a training: the victim and, where one hardens it, the defence, each with where it was trained.

    Args:
        name: readable, of all variants: `dqn`, `dqn-advtrain-pgd-skip0.3`.
        parts: the victim; then the defence, if there is one.
    """

    name: str
    parts: tuple[Part, ...]

    @classmethod
    def of(cls, victim: Victim, defense: Defense | None = None) -> Recipe:
        """The recipe of a victim's own training, or of what a defence makes of the victim.

        Raises:
            NotImplementedError: if it trains nothing.
        """
        if defense is None:
            return cls(name=_safe(victim.zoo_name()), parts=(Part.of("victim", victim, without="trained"),))
        hardened = Part.of("defense", defense, without="trained")
        return cls(name=_safe(defense.zoo_name(victim)), parts=(Part.of("victim", victim), hardened))

    @property
    def trained(self) -> Part:
        """The part that is trained: the defence, or else the victim."""
        return self.parts[-1]

    @property
    def digest(self) -> str:
        """sha256 of everything but the name and the seed, in hexadecimal."""
        return digest({part.kind: part.identity for part in self.parts})

    @property
    def key(self) -> str:
        """The name of the folder that holds the seeds of this recipe."""
        return f"{self.name}-{self.digest[:DIGITS]}"

    @property
    def options(self) -> list[str]:
        """The parameters that differ from their default, as on the command line."""
        return [option for part in self.parts for option in part.options]

    @property
    def trained_in(self) -> str:
        """The world of the training, as `trained_in` has it; empty for the default."""
        return str(self.trained.changed.get("trained_in", ""))

    @property
    def use(self) -> str:
        """The command that scores what it makes."""
        return shlex.join(["bench", "run", *self._components(), *self.options])

    def train(self, seed: int) -> str:
        """The command that trains it."""
        where = f"{self.trained.kind}.trained_in="
        options = [option for option in self.options if not option.startswith(where)]
        world = [f"world.{word}" if "=" in word else f"world={word}" for word in shlex.split(self.trained_in)]
        return shlex.join(["bench", "train", *self._components(), *options, *world, f"seeds={seed}"])

    def described(self) -> dict[str, object]:
        """What the card says of it."""
        return {"digest": self.digest, **{part.kind: part.described() for part in self.parts}}

    def _components(self) -> list[str]:
        return [f"{part.kind}={part.name}" for part in self.parts]


def trained_in(world: World, *, default: str) -> str:
    """A world as `trained_in` has it: name and parameters where they are not the default; empty for the default world.

    Args:
        world: to name, for instance `vehicles=5`.
        default: name of the track's default world.
    """
    part = Part.of("world", world)
    return _where(part.options, "" if part.name == default else part.name)


def check_world(recipe: Recipe, world: World) -> None:
    """Refuse a recipe that does not name the parameters of the world of its training.

    Raises:
        UserError: naming what `trained_in` should be.
    """
    part = Part.of("world", world)
    fitting = (_where(part.options, ""), _where(part.options, part.name))
    if recipe.trained_in not in fitting:
        said = f"trained_in={recipe.trained_in!r}" if recipe.trained_in else "the default world"
        raise UserError(
            f"{recipe.name!r} was trained in {' '.join([part.name, *part.options])!r}, but its recipe says {said}: "
            f"{recipe.trained.kind} {recipe.trained.name!r} needs a parameter trained_in={fitting[0]!r}"
        )


def _where(options: Sequence[str], name: str) -> str:
    parameters = [option.removeprefix("world.") for option in options]
    return shlex.join([name, *parameters] if name else parameters)


def _value(component: Component, parameter: Parameter) -> Any:
    """A parameter's value; the same number is the same value, an int or a float."""
    value = getattr(component, parameter.name)
    return float(value) if isinstance(parameter.default, float) and type(value) is int else value


def _differs(value: Any, parameter: Parameter) -> bool:
    return parameter.required or value != parameter.default


def _registered(kind: Kind, component: type[Component]) -> str:
    target = f"{component.__module__}:{component.__qualname__}"
    installed = registry.entries(GROUPS[kind]).items()
    return next((name for name, claims in installed if claims[0].target == target), component.__name__)


def _safe(name: str) -> str:
    """A name that is the name of a folder."""
    return re.sub(r"[^\w.+-]", "-", name)


def _text(value: Any) -> str:
    """A value as on the command line."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return f"[{','.join(map(_text, value))}]"
    text = str(value)
    if not isinstance(value, str) or (re.fullmatch(r"[\w./+-]+(=[\w./+-]+)?", text) and text not in MEANT_OTHERWISE):
        return text
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'
