"""Recipes: everything that determines the result of a training, except the seed. Entries of the zoo are named by their recipe.

Only non-default parameters are part of a recipe, so a new parameter with a default changes no recipe. Code is represented by
`training`, a version number on the class of a victim, defence or attack; its author raises it when the training changes.

The parameters that an attack lists in `at_run_time` are no part of its recipe. Two parameter names are special. `trained`
selects a training seed of the zoo and is not part of the component's own recipe.
`trained_in` names the training world if it is not the default.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cavbench.core import registry
from cavbench.core.contracts import Attack, Component, Defense, Victim, World
from cavbench.core.parameters import Parameter, differing, parameters
from cavbench.core.registry import GROUPS, Kind
from cavbench.errors import UserError
from cavbench.identity.fingerprint import digest

DIGITS = 8
"""Number of digits of the digest in a folder name."""
MEANT_OTHERWISE = ("null", "true", "false")
"""Strings that the command line would not read as strings."""

IN_DIGESTS = {
    "cavbench.attacks": "attacks",
    "cavbench.defenses": "defenses",
    "cavbench.envs": "envs",
    "cavbench": "bench",
}
"""Packages of cavbench as the digests of trained weights name them."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """The properties of a component that influence a training.

    Args:
        kind: victim, defense, attack or world.
        name: name on the command line; the class name if it is not installed.
        source: package and class, for instance `bench.DQN`; it does not change when a class moves within its package.
        module: module of the class.
        libraries: distributions whose versions influence the result.
        training: version of its training.
        parameters: all parameters.
        changed: parameters that differ from their default.
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
    def of(cls, kind: Kind, component: Component, *, without: Sequence[str] = ()) -> Part:
        """The part of a component, without the parameters `without`."""
        component_type = type(component)
        declared = {name: each for name, each in parameters(component_type).items() if name not in without}
        values = {name: _value(component, parameter) for name, parameter in declared.items()}
        return cls(
            kind=kind,
            name=_registered(kind, component_type),
            source=_class_name(component_type),
            module=component_type.__module__,
            libraries=component_type.libraries,
            training=component_type.training,
            parameters=values,
            changed={name: value for name, value in values.items() if _differs(value, declared[name])},
        )

    @property
    def options(self) -> list[str]:
        """Its non-default parameters, as on the command line: `victim.hidden=64`."""
        return [f"{self.kind}.{name}={_text(value)}" for name, value in self.changed.items()]

    @property
    def identity(self) -> dict[str, object]:
        """The input of the digest."""
        return {"class": self.source, "training": self.training, "changed": self.changed}

    def described(self) -> dict[str, object]:
        """Its entry in the card."""
        named = {"name": self.name, "class": self.source, "training": self.training}
        return {**named, "parameters": self.parameters, "changed": self.changed}


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Everything that determines a training: the victim and, if there are any, the defence and the attack.

    Args:
        name: readable name, shared by all variants: `dqn`, `dqn-advtrain-pgd-skip0.3`, `paad-dqn-advtrain`.
        parts: the victim, the defence, the attack; the last one is trained, and those that do not matter to it are absent.
        beside: the victim and the defence if they do not matter to the training of the attack; commands name them.
    """

    name: str
    parts: tuple[Part, ...]
    beside: tuple[Part, ...] = ()

    @classmethod
    def of(cls, victim: Victim, defense: Defense | None = None, attack: Attack | None = None) -> Recipe:
        """The recipe of a victim's training, of a defence's training of the victim, or of an attack's training against both.

        Raises:
            NotImplementedError: if the component has no training.
        """
        if attack is not None:
            return cls._of_adversary(victim, defense, attack)
        if defense is None:
            return cls(name=_safe(victim.zoo_name()), parts=(Part.of("victim", victim, without=("trained",)),))
        hardened = Part.of("defense", defense, without=("trained",))
        return cls(name=_safe(defense.zoo_name(victim)), parts=(Part.of("victim", victim), hardened))

    @classmethod
    def _of_adversary(cls, victim: Victim, defense: Defense | None, attack: Attack) -> Recipe:
        defended = [Part.of("victim", victim)]
        if defense is not None and (part := Part.of("defense", defense)).name != "none":
            defended.append(part)
        name, adversary = attack.zoo_name(victim), Part.of("attack", attack, without=attack.at_run_time)
        if not attack.adapts:
            return cls(name=_safe(name), parts=(adversary,), beside=tuple(defended))
        return cls(name=_safe("-".join([name, *(part.name for part in defended)])), parts=(*defended, adversary))

    @property
    def trained(self) -> Part:
        """The part that is trained: the last one."""
        return self.parts[-1]

    @property
    def digest(self) -> str:
        """Hexadecimal sha256 of everything except the name and the seed."""
        return digest({part.kind: part.identity for part in self.parts})

    @property
    def key(self) -> str:
        """The name of this recipe's folder."""
        return f"{self.name}-{self.digest[:DIGITS]}"

    @property
    def options(self) -> list[str]:
        """The non-default parameters, as on the command line."""
        return [option for part in (*self.beside, *self.parts) for option in part.options]

    @property
    def trained_in(self) -> str:
        """The training world, in the format of `trained_in`; empty for the default."""
        return str(self.trained.changed.get("trained_in", ""))

    @property
    def use(self) -> str:
        """The command that scores the trained component, in the world that it was trained in."""
        return shlex.join(["bench", "run", *self._components(), *self.options, *self._world()])

    def train(self, seed: int) -> str:
        """The command that trains it."""
        where = f"{self.trained.kind}.trained_in="
        options = [option for option in self.options if not option.startswith(where)]
        return shlex.join(["bench", "train", *self._components(), *options, *self._world(), f"seeds={seed}"])

    def described(self) -> dict[str, object]:
        """Its entry in the card."""
        return {"digest": self.digest, **{part.kind: part.described() for part in self.parts}}

    def _world(self) -> list[str]:
        """The training world, as on the command line; nothing for the default one."""
        return [f"world.{part}" if "=" in part else f"world={part}" for part in shlex.split(self.trained_in)]

    def _components(self) -> list[str]:
        return [f"{part.kind}={part.name}" for part in (*self.beside, *self.parts)]


def trained_in(world: World, *, default: str) -> str:
    """A world in the format of `trained_in`: non-default name and parameters, for instance `vehicles=5`.

    Args:
        world: the training world.
        default: name of the track's default world.
    """
    part = Part.of("world", world)
    return _where(part.options, "" if part.name == default else part.name)


def written(name: str, component: Component) -> str:
    """A component in one text, with its non-default parameters: `tracker+shield shield.band=6`."""
    return shlex.join([name, *(f"{key}={_text(value)}" for key, value in differing(component).items())])


def check_world(recipe: Recipe, world: World) -> None:
    """Check that a recipe names the non-default parameters of its training world.

    Raises:
        UserError: if it does not; the message has the correct `trained_in`.
    """
    part = Part.of("world", world)
    fitting = (_where(part.options, ""), _where(part.options, part.name))
    if recipe.trained_in not in fitting:
        named = f"trained_in={recipe.trained_in!r}" if recipe.trained_in else "the default world"
        raise UserError(
            f"{recipe.name!r} was trained in {' '.join([part.name, *part.options])!r}, but its recipe says {named}: "
            f"{recipe.trained.kind} {recipe.trained.name!r} needs a parameter trained_in={fitting[0]!r}"
        )


def _where(options: Sequence[str], name: str) -> str:
    parameters = [option.removeprefix("world.") for option in options]
    return shlex.join([name, *parameters] if name else parameters)


def _class_name(component: type[Component]) -> str:
    """The class in digests: its name in its top-level package. The name that a package of cavbench has there must not change."""
    module = component.__module__
    package = next(
        (old for new, old in IN_DIGESTS.items() if f"{module}.".startswith(f"{new}.")), module.partition(".")[0]
    )
    return f"{package}.{component.__qualname__}"


def _value(component: Component, parameter: Parameter) -> Any:
    """A parameter's value; an int for a float parameter becomes a float, so that equal numbers have one digest."""
    value = getattr(component, parameter.name)
    return float(value) if isinstance(parameter.default, float) and type(value) is int else value


def _differs(value: Any, parameter: Parameter) -> bool:
    return parameter.required or value != parameter.default


def _registered(kind: Kind, component: type[Component]) -> str:
    target = f"{component.__module__}:{component.__qualname__}"
    installed = registry.entries(GROUPS[kind]).items()
    return next((name for name, claims in installed if claims[0].target == target), component.__name__)


def _safe(name: str) -> str:
    """A name with characters that are safe in a folder name."""
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
