"""Components by name, and the pair: an attack on a defended victim in a world, under a threat model."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

from torch import nn

from bench.detection.contracts import Detector, DetectorVictim, PatchAttack
from bench.detection.threat import PatchThreat
from bench.driving.contracts import DrivingAttack, DrivingVictim, Policy
from bench.driving.threat import ObservationThreat
from bench.errors import UserError, reason
from bench.plugins import registry
from bench.plugins import sources as tracks
from bench.plugins.contracts import Attack, Defense, ThreatModel, Track, Victim, World, permits
from bench.plugins.fingerprint import canonical, digest, state_digest
from bench.plugins.parameters import parameters
from bench.plugins.registry import Kind

C = TypeVar("C", Attack, Defense, Victim, World)

THREATS: dict[Track, type[ThreatModel]] = {"driving": ObservationThreat, "detection": PatchThreat}
UNATTACKED: dict[Track, ThreatModel] = {
    "driving": ObservationThreat(budget=0.0, access="oblivious", queries=0),
    "detection": PatchThreat(budget=0.0, access="oblivious", queries=0),
}
"""The threat model of every clean run, so that runs with different threats share it."""
NETWORKS: dict[Track, type[nn.Module]] = {"driving": Policy, "detection": Detector}
"""What victims and defences of a track load."""


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
        raise UserError(f"{kind} {name!r}: {(str(error) or type(error).__name__).splitlines()[0]}") from error
    # A plug-in's own checks may fail in any other way.
    except Exception as error:
        raise UserError(f"{kind} {name!r} cannot be made: {reason(error)} (--debug shows where)") from error


def check_track(victim: Chosen[Any], *parts: Chosen[Any]) -> None:
    """Refuse components that are not of the victim's track.

    Raises:
        UserError: naming the first that is not, and what fits.
    """
    track = victim.component.tracks()[0]
    for part in parts:
        if track not in part.component.tracks():
            fitting = ", ".join(tracks.names(part.kind, track)) or "none is installed"
            raise UserError(
                f"{part.kind} {part.name!r} does not fit victim {victim.name!r} of the {track} track; what fits: {fitting}"
            )


@dataclass(frozen=True, kw_only=True)
class Pair:
    """An attack on a defended victim in a world, under a threat model: what a grid is driven with.

    Raises:
        UserError: if a part is of another track than the victim, or if the attack does not fit the victim or needs more than
            the threat model allows.
    """

    attack: Chosen[Attack]
    defense: Chosen[Defense]
    victim: Chosen[Victim]
    world: Chosen[World]
    threat: ThreatModel

    def __post_init__(self) -> None:
        attack, victim = self.attack.component, self.victim.component
        check_track(self.victim, self.attack, self.defense, self.world)
        if not isinstance(self.threat, THREATS[self.track]):
            raise UserError(f"a {type(self.threat).__name__} is no threat model of the {self.track} track")
        if isinstance(victim, DrivingVictim):
            self._check_driving(victim)
        if not permits(victim.answers, attack.access):
            raise UserError(
                f"attack {self.attack.name!r} needs access {attack.access!r}, victim {self.victim.name!r} answers "
                f"{victim.answers!r} at most: it is a black box"
            )
        if not self.threat.allows(attack.access):
            raise UserError(
                f"attack {self.attack.name!r} needs access {attack.access!r}, the threat model allows "
                f"{self.threat.access!r} at most; say threat.access={attack.access} to allow it"
            )

    def _check_driving(self, victim: DrivingVictim) -> None:
        attack = self.attack.component
        assert isinstance(attack, DrivingAttack)
        if victim.action_type not in attack.action_types:
            raise UserError(
                f"attack {self.attack.name!r} does not fit victim {self.victim.name!r}: "
                f"it needs {' or '.join(attack.action_types)} actions, the victim's are {victim.action_type}"
            )
        if not victim.sees and not self.is_clean:
            raise UserError(
                f"attack {self.attack.name!r} does not fit victim {self.victim.name!r}, which ignores what it is shown"
            )

    @property
    def track(self) -> Track:
        """The victim's."""
        return self.victim.component.tracks()[0]

    @property
    def is_seeded(self) -> bool:
        """Whether training seeds make a difference: to the victim, to its defence or, of a detector, to the patch."""
        attack, victim = self.attack.component, self.victim.component
        if self.track == "driving":
            return victim.learns
        assert isinstance(victim, DetectorVictim)
        return victim.seeded or self.defense.component.trains or (isinstance(attack, PatchAttack) and attack.seeded)

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
        names = f"{self.attack.name}-{self.defense.name}-{self.victim.name}".replace(":", "-")
        return f"{names}-{digest(self.identity)[:8]}"

    def clean(self) -> Pair:
        """The same victim and defence without the attack: the control of every attacked pair."""
        return replace(self, attack=choose("attack", "none"), threat=UNATTACKED[self.track])

    def weights_sha256(self, training_seed: int) -> str:
        """The hash that the defended network carries of its weights or, where it carries none, the hash of what it has.

        Raises:
            UserError: if it cannot be loaded, or is no network of the track.
        """
        try:
            network = self.defense.component.load(self.victim.component, training_seed)
        except UserError:
            raise
        # Third-party code may fail in any way; the person at the terminal is told which component did.
        except Exception as error:
            raise UserError(
                f"{self.defense} + {self.victim} cannot be loaded: {reason(error)} (--debug shows where)"
            ) from error
        if not isinstance(network, NETWORKS[self.track]):
            wanted = NETWORKS[self.track].__name__
            raise UserError(f"{self.defense} + {self.victim} is a {type(network).__name__} where a {wanted} is needed")
        carried = str(getattr(network, "weights_sha256", ""))
        return carried if carried or not network.state_dict() else state_digest(network)

    def __str__(self) -> str:
        return f"{self.attack} + {self.defense} + {self.victim}"
