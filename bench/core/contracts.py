"""Base classes of all plug-ins, of any track: World, Victim, Attack, Defense and ThreatModel.

A component is a frozen, keyword-only dataclass. Its fields are its parameters: they have the same names in the constructor, on
the command line (`attack.steps=50`) and in records. Their annotations give the allowed ranges (`cavbench.core.ranges`).

A track is a kind of victim (`cavbench.core.track`). Its base classes are in `cavbench.driving` and `cavbench.detection`; a
component that derives from both works on both tracks.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, Self, TypeVar, get_args

from cavbench.core import ranges, sets
from cavbench.errors import UserError
from cavbench.scenarios import Axes, Cell, Grid

if TYPE_CHECKING:
    # Reports read records and need no torch, which takes seconds to import.
    from torch import nn

ANY_TRACK = "any"
"""The track of a component that works on all of them, such as `none`."""
Access = Literal["oblivious", "decisions", "scores", "gradients", "dynamics"]
"""What an attacker may ask of the victim, from the least access to the most. `dynamics` also knows how the world moves."""
Progress = Callable[[float, str], None]
"""Called with the share done in [0, 1] and a short text; the command line draws a progress bar."""
Network = TypeVar("Network", bound="nn.Module")


class Component(ABC):
    """Anything that is chosen by name on the command line."""

    track: ClassVar[str]
    """Name of the track. Only the base classes of a track set it."""
    training: ClassVar[int] = 1
    """Version of its training. Raise it when a change of the code changes the trained weights."""
    libraries: ClassVar[tuple[str, ...]] = ()
    """Distributions that it computes with: records list their versions, besides torch and the other common libraries."""

    def __post_init__(self) -> None:
        """Check the fields against their annotations; a component with more checks calls this first."""
        ranges.check(self)

    @classmethod
    def choices(cls) -> Mapping[str, str]:
        """For an adapter to a library, the choices of `NAME:CHOICE`, each with a short description; otherwise empty."""
        return {}

    @classmethod
    def chosen(cls, choice: str) -> type[Component]:
        """The component class of `NAME:CHOICE`, where CHOICE is one of `choices`.

        Raises:
            UserError: if the library is not installed; the message names the command that installs it.
        """
        raise NotImplementedError(f"{cls.__name__} has no choices")

    @classmethod
    def modules(cls) -> tuple[str, ...]:
        """The modules whose code, with their imports, decides its results."""
        return (cls.__module__,)

    @classmethod
    def tracks(cls) -> tuple[str, ...]:
        """Names of the tracks whose base classes it derives from; `any` if it works on all."""
        names = dict.fromkeys(base.__dict__["track"] for base in cls.__mro__ if "track" in base.__dict__)
        return tuple(sorted(names, reverse=True))

    @classmethod
    def missing(cls) -> list[str]:
        """The required methods that it does not implement."""
        return sorted(getattr(cls, "__abstractmethods__", ()))

    @classmethod
    def serves(cls, track: str) -> bool:
        """Whether it can be used on a track."""
        return bool({track, ANY_TRACK} & set(cls.tracks()))


@dataclass(frozen=True, kw_only=True)
class Facts:
    """What victims, defences and reports may know of a world: published facts, never the hidden state.

    Args:
        axes: the axes of the world's cells.
        decision_hz: decisions per second; 0 if nothing is decided step by step.
        max_steps: decisions in a full episode; 0 if there are none.
        actions: names of the discrete actions, by number; empty if there are none.
    """

    axes: Axes
    decision_hz: float = 0.0
    max_steps: int = 0
    actions: tuple[str, ...] = ()

    def written(self) -> dict[str, Any]:
        """The facts as plain JSON values for records, so that a report needs no plug-in to read them."""
        values = {name: value for name, value in vars(self).items() if name != "axes"}
        return values | {"axes": [_without_defaults(axis) for axis in self.axes.values()]}


def _without_defaults(value: Any) -> dict[str, Any]:
    defaults = {name: field.default for name, field in type(value).__dataclass_fields__.items()}
    return {name: given for name, given in asdict(value).items() if given != defaults[name]}


class World(Component):
    """Where victims are tested: it creates the scenarios of a grid's cells."""

    axes: ClassVar[Axes]
    """The axes of its cells."""
    grid: ClassVar[str]
    """Name of the default grid of a run, an entry of `cavbench.grids`."""
    redraws: ClassVar[bool] = True
    """Whether every scenario seed is another scenario, so that an audit can draw scenarios that nobody knew before."""

    @property
    def facts(self) -> Facts:
        """What victims, defences and reports may know of this world."""
        return Facts(axes=self.axes)

    def own_grid(self) -> Grid | None:
        """The default grid of a world whose axes follow from its parameters; None for that of the name `grid`."""
        return None

    @classmethod
    def imports(cls, params: Mapping[str, Any]) -> str:
        """The module that these parameters make it import, which no plug-in of cavbench is; empty for none.

        A submission with one is refused: its sender would choose what runs.
        """
        return ""

    def facts_at(self, cell: Any) -> Facts:
        """The facts in a cell, where they depend on it: a range may follow from the number of lanes."""
        return self.facts

    def scenarios(self, cell: Any) -> int | None:
        """How many scenarios a cell has: those of so many seeds in a row differ, and further seeds repeat them.

        None if every seed is another one. More episodes than scenarios are refused: an interval would count each several times.

        Raises:
            UserError: if the world cannot be driven in this cell.
        """
        return None

    def doubts(self, cells: Sequence[Any]) -> Sequence[str]:
        """What makes scores in these cells doubtful, one line each; a run says it before it drives. It may take seconds.

        Raises:
            UserError: if the world cannot be driven in these cells.
        """
        return ()


class Victim(Component):
    """What is attacked. It can be loaded and, if it learns, trained."""

    network: ClassVar[type[Any]]
    """The class of the networks that victims and defences of the track load; set by the track's base class."""
    threat: ClassVar[type[ThreatModel]]
    """The class of the track's threat models; set by its base class."""
    learns: ClassVar[bool] = False
    sees: ClassVar[bool] = True
    """False if it ignores its input, so that neither attacks nor weather can affect it."""
    answers: ClassVar[Access] = "gradients"
    """The highest access that it supports: `scores` if it computes outside of torch and has no gradient."""

    @property
    def seeded(self) -> bool:
        """Whether `load` depends on the training seed."""
        return self.learns

    def zoo_name(self) -> str:
        """The name of its entries in the zoo; the names of its defended versions begin with it."""
        raise NotImplementedError(f"{type(self).__name__} does not learn")

    @abstractmethod
    def load(self, seed: int, facts: Any) -> nn.Module:
        """The network of training seed `seed`, in eval mode, without gradients on its weights.

        Args:
            seed: training seed.
            facts: facts of the world that it will be used in, in the class of its track.

        Raises:
            UserError: if it does not exist yet; the message names the command that makes it.
        """


class Attack(Component):
    """Changes what the victim sees, within a threat model.

    A random attack may have a parameter `draw: Natural = 0`. The run then seeds the attack's generator with it, too: another
    number is the same attack with other random numbers.

    An attack that learns has a network of its own, the adversary. `bench train attack=NAME victim=NAME` calls `train` and keeps
    the network in the zoo; a run calls `load`, and the attack finds the network in `self.adversary`.
    """

    access: ClassVar[Access]
    """The access that it needs: oblivious, decisions, scores, gradients or dynamics."""
    seeded: ClassVar[bool] = False
    """Whether it prepares something once for each training seed, such as a patch."""
    learns: ClassVar[bool] = False
    """Whether it has a network that `train` trains and `load` loads, once for each training seed."""
    adapts: ClassVar[bool] = True
    """Whether `train` depends on the defended victim; if not, one network serves all victims with the same `zoo_name`."""
    at_run_time: ClassVar[tuple[str, ...]] = ()
    """Names of the parameters that `train` does not use; they may be changed without another training."""
    adversary: Any = None
    """The network of an attack that learns, in a run; otherwise None. It is no parameter."""

    @property
    def forges(self) -> tuple[str, ...]:
        """What it needs of the threat model beside changed values: at least one of these words, such as `presence.hidden=1`."""
        return ()

    def zoo_name(self, victim: Any) -> str:
        """The name of its entries in the zoo; the names of victim and defence follow if it `adapts` to them."""
        raise NotImplementedError(f"{type(self).__name__} does not learn")

    def train(self, victim: Any, defense: Any, world: Any, *, seed: int, progress: Progress) -> Trained[Any]:
        """Train the adversary of training seed `seed`.

        Args:
            victim: the victim to attack.
            defense: its defence, possibly `none`; `defense.load(victim, seed, world.facts)` is the network to attack.
            world: the training world.
            seed: training seed of the adversary and of the victim.
            progress: called with the progress.
        """
        raise NotImplementedError(f"{type(self).__name__} does not learn")

    def load(self, victim: Any, defense: Any, seed: int, facts: Any) -> nn.Module:
        """The adversary of training seed `seed`, in eval mode; arguments as in `train`.

        Raises:
            UserError: if the zoo has no such adversary; the message has the command that trains it.
        """
        raise NotImplementedError(f"{type(self).__name__} does not learn")

    def armed(self, adversary: nn.Module) -> Self:
        """A copy of this attack that has the network `adversary`."""
        other = copy.copy(self)
        object.__setattr__(other, "adversary", adversary)
        return other

    def misfit(self, victim: Any) -> str:
        """Why it cannot attack a victim of its track, as the end of a sentence; empty if it can attack it."""
        return ""

    def lacks(self, world: Any) -> str:
        """What it misses in a world of its track, as a sentence; empty if it can be used there."""
        return ""


class Defense(Component):
    """Protects a victim: at training time, at run time, or both."""

    def train(self, victim: Any, world: Any, *, seed: int, progress: Progress) -> Trained[Any] | None:
        """Train the defended network of training seed `seed`; None if there is nothing to train."""
        return None

    def lacks(self, world: Any) -> str:
        """What it misses in a world of its track, as a sentence; empty if it can be used there."""
        return ""

    @property
    def learns(self) -> bool:
        """Whether it has weights of its own training, which the zoo keeps."""
        return type(self).train is not Defense.train

    @property
    def hardens(self) -> bool:
        """Whether what it trains is the victim, so that it comes first in a chain; otherwise it stands around the victim."""
        return self.learns

    @property
    def seeded(self) -> bool:
        """Whether the defended victim depends on a training seed of the run."""
        return self.learns

    def zoo_name(self, victim: Any) -> str:
        """The name of the zoo entries that `train` made from `victim`."""
        raise NotImplementedError(f"{type(self).__name__} trains nothing")

    @abstractmethod
    def load(self, victim: Any, seed: int, facts: Any) -> nn.Module:
        """Load the defended network, ready for use: from the zoo, wrapped, or both.

        Args:
            victim: the victim to protect.
            seed: training seed.
            facts: facts of the world that it will be used in, in the class of the track: features with units, decision rate,
                meaning of the actions.
        """


@dataclass(frozen=True)
class Trained(Generic[Network]):
    """The result of a training.

    Args:
        network: the trained network.
        card: what its card says about the training.
        start: the network that the training started from, if `load` has it anyway: the zoo stores only what differs.
    """

    network: Network
    card: Mapping[str, object]
    start: Network | None = None


@dataclass(frozen=True, kw_only=True)
class ThreatModel:
    """What an attacker may do. The framework enforces it.

    Args:
        norm: name of the perturbation set.
        budget: size of the perturbation set.
        access: the highest access allowed; attacks that need more are refused.
        queries: maximum number of evaluations of the victim.
    """

    norm: str
    budget: float
    access: Access = "gradients"
    queries: ranges.Natural

    marks: ClassVar[tuple[str, ...]] = ()
    """Names of its further text fields; where one is off its default, records have it in `threat_norm`: `patch+knows=site`."""

    def __post_init__(self) -> None:
        try:
            ranges.check(self)
            for name, kind in sets.of(type(self)).items():
                object.__setattr__(self, name, sets.made(name, kind, getattr(self, name)))
        except ValueError as error:
            raise ValueError(f"threat.{error}") from None

    @classmethod
    def of_nobody(cls) -> Self:
        """The threat model of all clean runs, so that runs under different threat models share them."""
        return cls(budget=0.0, access="oblivious", queries=0)  # type: ignore[call-arg]

    def lacks(self, world: Any, victim: Any) -> str:
        """Which of its sets the world cannot carry out, or makes no sense for the victim, in one line; empty for none."""
        return ""

    def slip(self) -> str:
        """What its budget would mean, if that is probably a slip of the pen; empty otherwise. A user confirms it in per cent."""
        return ""

    @property
    def columns(self) -> dict[str, Any]:
        """Its columns of records, `threat_NAME` for each field; `threat_share` is 1 where the track has no such limit.

        Sets that are not empty are named in `threat_norm` (`cavbench.core.sets`).
        """
        found = {name: getattr(self, name) for name in self._plain()}
        found["norm"] = "+".join([self.norm, *sets.words(self)])
        return {"threat_share": 1.0} | {f"threat_{name}": value for name, value in found.items()}

    @property
    def written(self) -> dict[str, Any]:
        """Its fields without the sets that are empty: the hash of a pair is that of records from before a set."""
        given = sets.present(self).keys() | sets.marked(self).keys()
        empty = {*sets.of(type(self)), *self.marks} - given
        return {item.name: getattr(self, item.name) for item in fields(self) if item.name not in empty}

    @classmethod
    def recorded(cls, record: Mapping[str, Any]) -> Self:
        """The threat model of a record.

        Raises:
            ValueError: if it has no such set, or a value is not allowed.
        """
        norm, words = sets.split(record["threat_norm"])
        own = {name: record[f"threat_{name}"] for name in cls._plain()}
        return cls(**own | {"norm": norm} | sets.read(cls, words))

    @classmethod
    def _plain(cls) -> list[str]:
        """The fields with a column of their own."""
        return [item.name for item in fields(cls) if item.name not in {*sets.of(cls), *cls.marks}]

    def known(self, cell: Cell, axes: Axes) -> Cell | None:
        """What an attack knows of the scored scenarios' cell when it prepares; None if it knows none of them.

        What is prepared is then made for each such cell and its scenarios.
        """
        return None

    def allows(self, access: Access) -> bool:
        """Whether this threat model allows an attack that needs `access`."""
        return permits(self.access, access)


def permits(allowed: Access, access: Access) -> bool:
    """Whether the access level `allowed` includes `access`."""
    return get_args(Access).index(access) <= get_args(Access).index(allowed)


def permit(asked: Access, declared: Access) -> None:
    """Refuse an attack that uses more access than it declares.

    Raises:
        UserError: if `asked` is above `declared`.
    """
    if not permits(declared, asked):
        raise UserError(f"the attack used access {asked!r}, but declares only {declared!r}: declare access={asked!r}")


class QueryBudgetError(UserError):
    """An attack exceeded the query budget of its threat model."""
