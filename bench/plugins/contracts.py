"""What every plug-in is, whatever its track: World, Victim, Attack, Defense, and the threat model between them.

A component is a frozen, keyword-only dataclass: its fields are its parameters, so that `attack.steps=50` on the command line,
the record of a run and the constructor are the same thing. Ranges stand in the annotations (`bench.plugins.ranges`).

A track is a kind of victim (`bench.plugins.track`). The base classes of the driving track are in `bench.driving`, those of the
detection track in `bench.detection`; a component that derives from both serves both.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, Self, TypeVar, get_args

from bench.errors import UserError
from bench.plugins import ranges
from bench.scenarios import Axes

if TYPE_CHECKING:
    # Reports read records and need no torch, which takes seconds to import.
    from torch import nn

ANY_TRACK = "any"
"""The track of a component that serves every one, as `none` does."""
Access = Literal["oblivious", "decisions", "scores", "gradients"]
"""What an attacker may ask of the victim, in rising order."""
Progress = Callable[[float, str], None]
"""Called with the share done in [0, 1] and a short text; the command line draws the bar."""
Network = TypeVar("Network", bound="nn.Module")


class Component(ABC):
    """What has a name on the command line."""

    track: ClassVar[str]
    """Name of the track, set by the base classes of a track, and by them only."""
    training: ClassVar[int] = 1
    """Version of what it trains, if it does; raised when a change of the code changes the weights that it makes."""
    libraries: ClassVar[tuple[str, ...]] = ()
    """Distributions that compute for it: records name their versions, beside those of torch and the rest."""

    def __post_init__(self) -> None:
        """Check the fields against their annotations; a component that checks more calls this first."""
        ranges.check(self)

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
    def tracks(cls) -> tuple[str, ...]:
        """The names of the tracks whose base classes it derives from; `any` for one that serves all."""
        own = dict.fromkeys(base.__dict__["track"] for base in cls.__mro__ if "track" in base.__dict__)
        return tuple(sorted(own, reverse=True))

    @classmethod
    def missing(cls) -> list[str]:
        """The methods that it must have and does not implement."""
        return sorted(getattr(cls, "__abstractmethods__", ()))

    @classmethod
    def serves(cls, track: str) -> bool:
        """Whether it can be used on a track."""
        return bool({track, ANY_TRACK} & set(cls.tracks()))


@dataclass(frozen=True, kw_only=True)
class Facts:
    """What a victim or a defence may know of its world, and a report needs: the published facts, never the hidden state.

    Args:
        axes: what the cells of the world differ in.
        decision_hz: decisions a second; 0 where nothing is decided step by step.
        max_steps: decisions of an episode that runs to its end; 0 where there are none.
        actions: names of the discrete actions, by number; empty where there are none.
    """

    axes: Axes
    decision_hz: float = 0.0
    max_steps: int = 0
    actions: tuple[str, ...] = ()

    def written(self) -> dict[str, Any]:
        """As plain JSON values, for records: a report needs no plug-in to read them."""
        values = {name: value for name, value in vars(self).items() if name != "axes"}
        return values | {"axes": [_without_defaults(axis) for axis in self.axes.values()]}


def _without_defaults(value: Any) -> dict[str, Any]:
    defaults = {name: field.default for name, field in type(value).__dataclass_fields__.items()}
    return {name: found for name, found in asdict(value).items() if found != defaults[name]}


class World(Component):
    """Where victims are put to the test: it makes what the cells of a grid stand for."""

    axes: ClassVar[Axes]
    """What its cells differ in."""
    grid: ClassVar[str]
    """Name of the grid that a run drives when it is not told otherwise, an entry of `cavbench.grids`."""

    @property
    def facts(self) -> Facts:
        """What victims, defences and reports may know of it."""
        return Facts(axes=self.axes)


class Victim(Component):
    """What is attacked: how to load it and, if it learns, how to train it."""

    network: ClassVar[type[Any]]
    """What victims of the track load, and defences make of them; set by the track's base class."""
    threat: ClassVar[type[ThreatModel]]
    """The class of the track's threat models; set by its base class."""
    learns: ClassVar[bool] = False
    sees: ClassVar[bool] = True
    """False for one that ignores what it is shown: no attack and no weather can touch it."""
    answers: ClassVar[Access] = "gradients"
    """The most that it can be asked: `scores` for one that computes outside of torch, and so has no gradient."""

    @property
    def seeded(self) -> bool:
        """Whether `load` gives another network for another training seed."""
        return self.learns

    def zoo_name(self) -> str:
        """The name of this victim's entries in the zoo, and the beginning of the name of what defences make of it."""
        raise NotImplementedError(f"{type(self).__name__} does not learn")

    @abstractmethod
    def load(self, seed: int, facts: Any) -> nn.Module:
        """The network of training seed `seed`, in eval mode, without gradients on its weights.

        Args:
            seed: training seed.
            facts: of the world it is going to be used in, in the class of its track.

        Raises:
            UserError: if it is not there, saying which command makes it.
        """


class Attack(Component):
    """Changes what the victim sees, within a threat model."""

    access: ClassVar[Access]
    """The least access it needs: oblivious, decisions, scores or gradients."""
    seeded: ClassVar[bool] = False
    """Whether it makes something once for every training seed, as a patch is crafted."""

    def misfit(self, victim: Any) -> str:
        """Why it cannot attack a victim of its track, as the end of a sentence; empty if it can."""
        return ""


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
    def load(self, victim: Any, seed: int, facts: Any) -> nn.Module:
        """The defended network, ready for use: from the zoo, wrapped, or both.

        Args:
            victim: what is protected.
            seed: training seed.
            facts: of the world it is going to be used in, in the class of the track: what features measure and in what units,
                how often is decided, what actions mean.
        """


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
    queries: ranges.Natural

    def __post_init__(self) -> None:
        try:
            ranges.check(self)
        except ValueError as error:
            raise ValueError(f"threat.{error}") from None

    @classmethod
    def of_nobody(cls) -> Self:
        """The threat model of every clean run, so that runs under different threats share it."""
        return cls(budget=0.0, access="oblivious", queries=0)  # type: ignore[call-arg]

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
