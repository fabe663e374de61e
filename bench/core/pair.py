"""Components chosen by name, and pairs: an attack on a defended victim in a world, under a threat model."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Generic, TypeVar

from cavbench.core import registry, sets, sources
from cavbench.core.contracts import Access, Attack, Defense, ThreatModel, Victim, World, permits
from cavbench.core.outline import outline
from cavbench.core.parameters import differing, parameters
from cavbench.core.registry import Kind
from cavbench.core.settings import frozen
from cavbench.errors import PluginError, UserError, message, reason
from cavbench.identity.fingerprint import canonical, digest, state_digest
from cavbench.isolation.foreign import contained, unchanged
from cavbench.isolation.framework import OWN
from cavbench.scenarios import Cell

IN_PROCESS = "a Python process"
"""What records say of a component that no package ships."""
C = TypeVar("C", Attack, Defense, Victim, World)


@dataclass(frozen=True, kw_only=True)
class Chosen(Generic[C]):
    """A component with its registered name.

    Args:
        kind: attack, defense, victim or world.
        name: name of the entry point.
        component: the instance; its fields are its parameters.
        code: hash of its code, for an object of Python that no package ships; otherwise empty.
    """

    kind: Kind
    name: str
    component: C
    code: str = ""

    @property
    def params(self) -> str:
        """The parameters as canonical JSON."""
        return canonical(self.component)

    @property
    def shipped_by(self) -> str:
        """The distribution and version that ship it; `IN_PROCESS` for an object of Python."""
        return IN_PROCESS if self.code else registry.find(registry.GROUPS[self.kind], self.name, self.kind).shipped_by

    def __str__(self) -> str:
        """The name, with the parameters that differ from their defaults: `pgd(steps=20)`."""
        if self.code and (self.kind == "victim" or hasattr(self.component, "content")):
            # Its parameters only say what the object was.
            return self.name
        changed = [f"{name}={value}" for name, value in differing(self.component).items()]
        return f"{self.name}({', '.join(changed)})" if changed else self.name


def choose(kind: Kind, name: str, **params: object) -> Chosen[Any]:
    """A component by name, with these parameters; the others keep their defaults.

    Raises:
        UserError: if the name is unknown, the plug-in is broken, or a value is not allowed.
    """
    component = registry.load(kind, name)
    try:
        with contained(), nullcontext() if component.__module__.partition(".")[0] == OWN else unchanged():
            return Chosen(kind=kind, name=name, component=component(**params))
    except (ValueError, TypeError, UserError) as error:
        raise UserError(f"{kind} {name!r}: {message(error) or type(error).__name__}") from error
    # The checks of a plug-in may raise anything else.
    except Exception as error:
        raise PluginError(
            f"{kind} {name!r} cannot be created: {reason(error)} (--debug shows the traceback)"
        ) from error


def label(kind: Kind, name: str, params: Mapping[str, Any]) -> str:
    """What tables call a component with the parameters of a record, as `str(Chosen)`.

    It is not created, for anyone may write records, and not imported where its source says its defaults: that takes seconds.

    Raises:
        UserError: if there is no such component.
    """
    owned = parameters(outline(kind, name) or registry.load(kind, name))
    given = {key: frozen(params[key]) for key in owned if key in params}
    changed = [
        f"{key}={value}" for key, value in given.items() if owned[key].required or value != frozen(owned[key].default)
    ]
    return f"{name}({', '.join(changed)})" if changed else name


def check_track(victim: Chosen[Any], *parts: Chosen[Any]) -> None:
    """Refuse components that do not work on the victim's track.

    Raises:
        UserError: names the first such component, and those that fit.
    """
    track = victim.component.tracks()[0]
    for part in parts:
        if not part.component.serves(track):
            fitting = ", ".join(sources.names(part.kind, track)) or "none is installed"
            raise UserError(
                f"{part.kind} {part.name!r} does not fit victim {victim.name!r} of the {track} track; fitting: {fitting}"
            )


@dataclass(frozen=True, kw_only=True)
class Pair:
    """An attack on a defended victim in a world, under a threat model: what a run evaluates on a grid.

    Raises:
        UserError: if a component does not work on the victim's track, or if the attack does not fit the victim or needs more
            access than the threat model allows.
    """

    attack: Chosen[Attack]
    defense: Chosen[Defense]
    victim: Chosen[Victim]
    world: Chosen[World]
    threat: ThreatModel

    def __post_init__(self) -> None:
        attack, victim = self.attack.component, self.victim.component
        check_track(self.victim, self.attack, self.defense, self.world)
        if not isinstance(self.threat, victim.threat):
            raise UserError(f"{type(self.threat).__name__} is not a threat model of the {self.track} track")
        if not self.is_clean and (why := attack.misfit(victim) or ("" if victim.sees else "which ignores its input")):
            raise UserError(f"attack {self.attack.name!r} does not fit victim {self.victim.name!r}, {why}")
        for part in (self.defense,) if self.is_clean else (self.attack, self.defense):
            if missing := part.component.lacks(self.world.component):
                raise UserError(f"{part.kind} {part.name!r} does not fit world {self.world.name!r}: {missing}")
        # The dynamics are the world's: of the victim such an attack asks what a white-box attack asks.
        asked: Access = "gradients" if attack.access == "dynamics" else attack.access
        if not permits(victim.answers, asked):
            raise UserError(
                f"attack {self.attack.name!r} needs access {asked!r}, but victim {self.victim.name!r} is a black box "
                f"that supports {victim.answers!r} at most"
            )
        if why := "" if self.is_clean else self.threat.lacks(self.world.component, victim):
            raise UserError(f"attack {self.attack.name!r} does not fit world {self.world.name!r}: {why}")
        if not self.is_clean and attack.forges and not any(sets.allows(self.threat, word) for word in attack.forges):
            raise UserError(
                f"attack {self.attack.name!r} can do nothing under this threat model: allow it "
                f"{' or '.join(f'threat.{word}' for word in attack.forges)}"
            )
        if not self.threat.allows(attack.access):
            raise UserError(
                f"attack {self.attack.name!r} needs access {attack.access!r}, but the threat model allows "
                f"{self.threat.access!r} at most; allow it with threat.access={attack.access}"
            )

    @property
    def track(self) -> str:
        """Name of the victim's track."""
        return self.victim.component.tracks()[0]

    @property
    def parts(self) -> tuple[Chosen[Any], ...]:
        """The four components."""
        return self.attack, self.defense, self.victim, self.world

    @property
    def is_seeded(self) -> bool:
        """Whether the victim, its defence, the attack's preparation or its network depends on the training seed."""
        attack = self.attack.component
        return self.victim.component.seeded or self.defense.component.seeded or attack.seeded or attack.learns

    @property
    def is_clean(self) -> bool:
        """Whether there is no attack."""
        return self.attack.name == "none"

    @cached_property
    def identity(self) -> Mapping[str, str]:
        """Names and parameters of everything in the pair."""
        named = {part.kind: part.name for part in self.parts}
        return (
            named
            | {f"{part.kind}_params": part.params for part in self.parts}
            | {"threat": canonical(self.threat.written)}
        )

    @property
    def id(self) -> str:
        """A short name for files and tables: the component names and eight digits of the identity's hash."""
        names = f"{self.attack.name}-{self.defense.name}-{self.victim.name}".replace(":", "-")
        return f"{names}-{digest(self.identity)[:8]}"

    def clean(self) -> Pair:
        """The same victim and defence without the attack: the clean control."""
        return replace(self, attack=choose("attack", "none"), threat=type(self.threat).of_nobody())

    def load(self, training_seed: int, cell: Cell | None = None) -> Any:
        """The defended network of a training seed, for a cell of its world if one is given."""
        # Plug-ins get copies: what they do to them reaches neither the run nor the world.
        world = self.world.component
        facts = copy.deepcopy(world.facts if cell is None else world.facts_at(cell))
        return self.defense.component.load(copy.copy(self.victim.component), training_seed, facts)

    def armed(self, training_seed: int) -> Attack:
        """The attack, with its network of a training seed if it learns."""
        attack = self.attack.component
        if not attack.learns:
            return attack
        facts = copy.deepcopy(self.world.component.facts)
        victim, defense = copy.copy(self.victim.component), copy.copy(self.defense.component)
        return attack.armed(attack.load(victim, defense, training_seed, facts))

    def adversary_sha256(self, training_seed: int) -> str:
        """The hash of the weights of an attack that learns; otherwise empty.

        Raises:
            UserError: if the network cannot be loaded.
        """
        adversary = _loaded(str(self.attack), lambda: self.armed(training_seed).adversary)
        return "" if adversary is None else weights_of(adversary)

    @property
    def defended(self) -> str:
        """The victim, and its defence if it has one, as in a sentence."""
        return str(self.victim) if self.defense.name == "none" else f"{self.defense} + {self.victim}"

    def network(self, training_seed: int) -> Any:
        """The defended network of a training seed, as `load`.

        Raises:
            UserError: if it cannot be loaded, or is not a network of the track.
        """
        network = _loaded(self.defended, lambda: self.load(training_seed))
        wanted = self.victim.component.network
        if not isinstance(network, wanted):
            raise PluginError(f"{self.defended} loads a {type(network).__name__}, but a {wanted.__name__} is needed")
        return network

    def weights_sha256(self, training_seed: int) -> str:
        """The hash of the weights of the defended network.

        Raises:
            UserError: if it cannot be loaded, or is not a network of the track.
        """
        return weights_of(self.network(training_seed))

    def __str__(self) -> str:
        return f"{self.attack} + {self.defense} + {self.victim}"


def _loaded(named: str, load: Callable[[], Any]) -> Any:
    """What `load` returns; a UserError that names the component if it fails."""
    try:
        with contained():
            return load()
    except UserError:
        raise
    # Third-party code may raise anything: name the component that failed.
    except Exception as error:
        raise PluginError(f"{named} cannot be loaded: {reason(error)} (--debug shows the traceback)") from error


def weights_of(network: Any) -> str:
    """The network's own `weights_sha256`; if it has none, the hash of its state, which is empty without weights."""
    carried = str(getattr(network, "weights_sha256", ""))
    return carried if carried or not network.state_dict() else state_digest(network)
