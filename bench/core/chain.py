"""Chains of defences: `defense=tracker+shield` is one component, whose parameters are its links."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import MISSING, field, fields, make_dataclass
from functools import cache
from typing import Any, cast

from cavbench.core.contracts import ANY_TRACK, Defense, Victim
from cavbench.core.names import MARK
from cavbench.errors import UserError


class Chain(Defense):
    """Several defences, one behind the other: the observation passes them in the order of their names.

    A defence that trains its victim comes first; the trained victim is behind all others.
    """

    @classmethod
    def tracks(cls) -> tuple[str, ...]:
        served = [set(link.tracks()) for link in cls._types()]
        bound = [tracks for tracks in served if ANY_TRACK not in tracks]
        return tuple(sorted(set.intersection(*bound), reverse=True)) if bound else (ANY_TRACK,)

    @classmethod
    def modules(cls) -> tuple[str, ...]:
        return tuple(module for link in cls._types() for module in link.modules())

    @property
    def links(self) -> tuple[Defense, ...]:
        """The defences, in order."""
        return tuple(getattr(self, name) for name in self._fields())

    @property
    def parted(self) -> tuple[tuple[str, Defense] | None, tuple[str, Defense] | None]:
        """The link that trains its victim, and those at run time as one defence: each with its name, or None."""
        named = [(name, getattr(self, name)) for name in self._fields()]
        first, others = (named[0], named[1:]) if named[0][1].hardens else (None, named)
        if len(others) < 2:
            return first, next(iter(others), None)
        return first, (MARK.join(name for name, _ in others), _linked(*others))

    def lacks(self, world: Any) -> str:
        return next(filter(None, (link.lacks(world) for link in self.links)), "")

    @property
    def learns(self) -> bool:
        return any(link.learns for link in self.links)

    @property
    def hardens(self) -> bool:
        return any(link.hardens for link in self.links)

    @property
    def seeded(self) -> bool:
        return any(link.seeded for link in self.links)

    def train(self, victim: Any, world: Any, *, seed: int, progress: Any) -> None:
        """Refused: a link is trained by itself.

        Raises:
            UserError: names what to train.
        """
        trained = [name for name in self._fields() if getattr(self, name).learns]
        if trained:
            raise UserError(f"train defense={trained[0]} by itself; the chain loads what was trained")

    def zoo_name(self, victim: Any) -> str:
        trained = next((link for link in self.links if link.learns), None)
        return trained.zoo_name(victim) if trained else super().zoo_name(victim)

    def load(self, victim: Victim, seed: int, facts: Any) -> Any:
        first, *others = self.links
        behind = (first, *reversed(others)) if first.hardens else (*reversed(self.links),)
        for link in behind:
            victim = _defended(victim, link)
        return victim.load(seed, facts)

    def __reduce__(self) -> tuple[Any, ...]:
        # The class is in no module, so a worker process makes it again.
        return _linked, tuple((name, getattr(self, name)) for name in self._fields())

    @classmethod
    def _fields(cls) -> tuple[str, ...]:
        return tuple(each.name for each in fields(cast(Any, cls)))

    @classmethod
    def _types(cls) -> list[type[Defense]]:
        return [cast("type[Defense]", each.default_factory) for each in fields(cast(Any, cls))]


@cache
def chained(links: tuple[tuple[str, type[Defense]], ...]) -> type[Chain]:
    """The class of a chain; its parameters are the links, by name.

    Raises:
        UserError: if a link occurs twice, needs a parameter, or trains and is not the first.
    """
    names = [name for name, _ in links]
    if len(set(names)) < len(names) or not all(name.isidentifier() for name in names):
        raise UserError(f"defense {MARK.join(names)!r}: a chain takes each defence once, and none as NAME:CHOICE")
    for name, link in links:
        if needed := [one.name for one in fields(cast("Any", link)) if one.default is MISSING is one.default_factory]:
            raise UserError(f"defense {MARK.join(names)!r}: {name!r} needs {needed[0]}, but links have defaults")
    if late := [name for name, link in links[1:] if link().hardens]:
        raise UserError(f"defense {MARK.join(names)!r}: {late[0]!r} trains its victim, so it must come first")
    parts: list[Any] = [(name, link, field(default_factory=link)) for name, link in links]
    made = cast("type[Chain]", make_dataclass(MARK.join(names), parts, bases=(Chain,), frozen=True, kw_only=True))
    made.__module__ = Chain.__module__
    made.__doc__ = "\n".join(["A chain of defences.", "", "Args:", *(f"    {name}: a link." for name in names)])
    made.libraries = tuple(sorted({library for _, link in links for library in link.libraries}))
    if not made.tracks():
        raise UserError(f"the defences of {MARK.join(names)!r} are for different tracks")
    return made


def _linked(*links: tuple[str, Defense]) -> Chain:
    whole = chained(tuple((name, type(link)) for name, link in links))
    return whole(**dict(links))


def _defended(victim: Victim, link: Defense) -> Victim:
    """A copy of the victim whose `load` returns it behind a link."""

    def load(seed: int, facts: Any) -> Any:
        return link.load(victim, seed, facts)

    other = copy.copy(victim)
    loaded: Callable[[int, Any], Any] = load
    object.__setattr__(other, "load", loaded)
    return other
