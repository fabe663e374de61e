"""Components by name, and the pair: an attack on a defended victim in a world, under a threat model."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

from bench import registry
from bench.contracts import Attack, Defense, Victim, World
from bench.errors import UserError
from bench.fingerprint import canonical, digest
from bench.parameters import parameters
from bench.registry import Kind
from bench.threat import ThreatModel

C = TypeVar("C", Attack, Defense, Victim, World)

UNATTACKED = ThreatModel(budget=0.0, access="oblivious", queries=0)
"""The threat model of every clean run, so that runs with different threats share it."""


@dataclass(frozen=True, kw_only=True)
class Chosen(Generic[C]):
    """A component with the name it was registered by.

    Args:
        kind: attack, defense, victim or world.
        name: of the entry point.
        component: the instance; its fields are its parameters.
    """

    kind: Kind
    name: str
    component: C

    @property
    def params(self) -> str:
        """Its parameters as canonical JSON."""
        return canonical(self.component)

    def __str__(self) -> str:
        """The name, with the parameters that are not the default: `pgd(steps=20)`."""
        own = {p.name: (getattr(self.component, p.name), p) for p in parameters(type(self.component)).values()}
        changed = [f"{name}={value}" for name, (value, p) in own.items() if p.required or value != p.default]
        return f"{self.name}({', '.join(changed)})" if changed else self.name


def choose(kind: Kind, name: str, **params: object) -> Chosen[Any]:
    """A component by name, with these parameters and the defaults of the others.

    Raises:
        UserError: if the name is unknown, the plug-in broken or a value not allowed.
    """
    component = registry.load(kind, name)
    try:
        return Chosen(kind=kind, name=name, component=component(**params))
    except (ValueError, TypeError) as error:
        raise UserError(f"{kind} {name!r}: {str(error).splitlines()[0]}") from error


@dataclass(frozen=True, kw_only=True)
class Pair:
    """An attack on a defended victim in a world, under a threat model: what a grid is driven with.

    Raises:
        UserError: if the attack does not fit the victim or needs more than the threat model allows.
    """

    attack: Chosen[Attack]
    defense: Chosen[Defense]
    victim: Chosen[Victim]
    world: Chosen[World]
    threat: ThreatModel

    def __post_init__(self) -> None:
        attack, victim = self.attack.component, self.victim.component
        if victim.action_type not in attack.action_types:
            raise UserError(
                f"attack {self.attack.name!r} does not fit victim {self.victim.name!r}: "
                f"it needs {' or '.join(attack.action_types)} actions, the victim's are {victim.action_type}"
            )
        if not victim.sees and not self.is_clean:
            raise UserError(
                f"attack {self.attack.name!r} does not fit victim {self.victim.name!r}, which ignores what it is shown"
            )
        if not self.threat.allows(attack.access):
            raise UserError(
                f"attack {self.attack.name!r} needs access {attack.access!r}, the threat model allows "
                f"{self.threat.access!r} at most; say threat.access={attack.access} to allow it"
            )

    @property
    def is_clean(self) -> bool:
        """Whether nothing stands between the world and the victim."""
        return self.attack.name == "none"

    @property
    def identity(self) -> dict[str, str]:
        """Names and parameters of everything in the pair."""
        parts: tuple[Chosen[Any], ...] = (self.attack, self.defense, self.victim, self.world)
        named = {part.kind: part.name for part in parts}
        return named | {f"{part.kind}_params": part.params for part in parts} | {"threat": canonical(self.threat)}

    @property
    def id(self) -> str:
        """A short name for files and tables: the names and eight digits of the hash of the identity."""
        return f"{self.attack.name}-{self.defense.name}-{self.victim.name}-{digest(self.identity)[:8]}"

    def clean(self) -> Pair:
        """The same victim and defence without the attack: the control of every attacked pair."""
        return replace(self, attack=choose("attack", "none"), threat=UNATTACKED)

    def weights_sha256(self, training_seed: int) -> str:
        """The hash that the defended policy carries of its weights or, where it carries none, the hash of what it has.

        Raises:
            UserError: if the policy cannot be loaded.
        """
        policy = self.defense.component.load(self.victim.component, training_seed)
        state = policy.state_dict()
        if policy.weights_sha256 or not state:
            return policy.weights_sha256
        hasher = hashlib.sha256()
        for name, value in sorted(state.items()):
            hasher.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
            hasher.update(value.detach().cpu().contiguous().numpy().tobytes())
        return hasher.hexdigest()

    def __str__(self) -> str:
        return f"{self.attack} + {self.defense} + {self.victim}"
