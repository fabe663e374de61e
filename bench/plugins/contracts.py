"""What every plug-in is, whatever its track: World, Victim, Attack, Defense, and the threat model between them.

A component is a frozen, keyword-only dataclass: its fields are its parameters, so that `attack.steps=50` on the command line,
the record of a run and the constructor are the same thing. Check ranges in `__post_init__` and raise ValueError with one line.

A track is a kind of victim. The base classes of `driving` are in `bench.driving.contracts`, those of `detection` in `bench.detection.contracts`; a
component that derives from both serves both.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, TypeVar, get_args

from bench.errors import UserError

if TYPE_CHECKING:
    # Reports read records and need no torch, which takes seconds to import.
    from torch import nn

Track = Literal["driving", "detection"]
TRACKS: tuple[Track, ...] = get_args(Track)
REFERENCE_PATCHES = ("noise_patch", "grey_patch")
"""The attacks on detectors that every other is held against, where they are installed: patches that know nothing."""
Access = Literal["oblivious", "decisions", "scores", "gradients"]
"""What an attacker may ask of the victim, in rising order."""
Progress = Callable[[float, str], None]
"""Called with the share done in [0, 1] and a short text; the command line draws the bar."""
Network = TypeVar("Network", bound="nn.Module")


class Component(ABC):
    """What has a name on the command line."""

    track: ClassVar[Track]
    """Set by the base classes of a track, and by them only."""
    libraries: ClassVar[tuple[str, ...]] = ()
    """Distributions that compute for it: records name their versions, beside those of torch and the rest."""

    @classmethod
    def choices(cls) -> Mapping[str, str]:
        """Of an adapter to a library: what can be said after its name, `NAME:CHOICE`, and a word on each; else empty."""
        return {}

    @classmethod
    def chosen(cls, choice: str) -> type[Component]:
        """The component that `NAME:CHOICE` is, for every one of the `choices`.

        Raises:
            UserError: if the library is not installed, saying which command installs it.
        """
        raise NotImplementedError(f"{cls.__name__} leaves no choice")

    @classmethod
    def tracks(cls) -> tuple[Track, ...]:
        """The tracks whose base classes it derives from."""
        own = {base.__dict__.get("track") for base in cls.__mro__}
        return tuple(track for track in TRACKS if track in own)


class World(Component):
    """Where victims are put to the test: it makes what the cells of a grid stand for."""


class Victim(Component):
    """What is attacked: how to load it and, if it learns, how to train it."""

    learns: ClassVar[bool] = False
    answers: ClassVar[Access] = "gradients"
    """The most that it can be asked: `scores` for one that computes outside of torch, and so has no gradient."""

    def zoo_name(self) -> str:
        """The name of this victim's entries in the zoo, and the beginning of the name of what defences make of it."""
        raise NotImplementedError(f"{type(self).__name__} does not learn")

    @abstractmethod
    def load(self, seed: int) -> nn.Module:
        """The network of training seed `seed`, in eval mode, without gradients on its weights.

        Raises:
            UserError: if it is not there, saying which command makes it.
        """


class Attack(Component):
    """Changes what the victim sees, within a threat model."""

    access: ClassVar[Access]
    """The least access it needs: oblivious, decisions, scores or gradients."""


class Defense(Component):
    """Protects a victim: at training time, at run time, or both."""

    def train(self, victim: Any, world: Any, *, seed: int, progress: Progress) -> Trained[Any] | None:
        """Train the hardened network of training seed `seed`; None where there is nothing to train."""
        return None

    @property
    def trains(self) -> bool:
        """Whether what it makes of a victim depends on a training seed."""
        return type(self).train is not Defense.train

    def zoo_name(self, victim: Any) -> str:
        """The name of the zoo entries that hold what `train` made of `victim`."""
        raise NotImplementedError(f"{type(self).__name__} trains nothing")

    @abstractmethod
    def load(self, victim: Any, seed: int) -> nn.Module:
        """The defended network, ready for use: from the zoo, wrapped, or both."""


@dataclass(frozen=True)
class Trained(Generic[Network]):
    """What a training leaves: the network, and what its card says of the training."""

    network: Network
    card: Mapping[str, object]


@dataclass(frozen=True, kw_only=True)
class ThreatModel:
    """What an attacker may do. Enforced, never trusted.

    Args:
        norm: names the set of changes it may choose from.
        budget: size of that set.
        access: the most an attack may use; attacks that need more are refused.
        queries: most evaluations of the victim.
    """

    norm: str
    budget: float
    access: Access = "gradients"
    queries: int

    def __post_init__(self) -> None:
        if self.access not in get_args(Access):
            raise ValueError(f"threat.access must be one of {', '.join(get_args(Access))}, got {self.access!r}")
        if self.queries < 0:
            raise ValueError(f"threat.queries must be at least 0, got {self.queries}")

    def allows(self, access: Access) -> bool:
        """Whether an attack that needs `access` fits this threat model."""
        return permits(self.access, access)


def permits(allowed: Access, access: Access) -> bool:
    """Whether who may use `allowed` may use `access`."""
    return get_args(Access).index(access) <= get_args(Access).index(allowed)


def permit(asked: Access, declared: Access) -> None:
    """Refuse an attack that asks for more than it declares that it needs.

    Raises:
        UserError: if it does.
    """
    if not permits(declared, asked):
        raise UserError(f"the attack asked for {asked!r}, but declares that it needs {declared!r} only")


class QueryBudgetError(UserError):
    """An attack asked for more queries than its threat model allows."""
