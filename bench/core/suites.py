"""Suites: fixed, versioned lists of attacks, found by their entry points `cavbench.suites` and written as TOML.

`attack=standard` means every member of the newest suite `standard-N`, on another track than driving of the newest
`standard-TRACK-N`; `attack=standard-2` is fixed. Each member that fits the
victim is run and recorded as the ordinary pair that it is.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cavbench.core import registry, sets
from cavbench.core.contracts import Access
from cavbench.core.pair import Chosen, Pair, choose
from cavbench.errors import UserError

VERSIONED = re.compile(r"(?P<family>.+)-(?P<version>\d+)")


@dataclass(frozen=True, kw_only=True)
class Member:
    """An attack of a suite.

    Args:
        attack: its registered name.
        params: its parameters; the others keep their defaults.
        victims: attributes that a victim must have for the member to be meant for it, for instance {"action_type": "discrete"}.
        threat: what it has in fields of the sets of the threat model, beside what is allowed, such as {"dynamics.time_gap": 0.6}.
        purpose: why it is in the suite.
    """

    attack: str
    params: Mapping[str, Any] = field(default_factory=dict)
    victims: Mapping[str, Any] = field(default_factory=dict)
    threat: Mapping[str, float] = field(default_factory=dict)
    purpose: str = ""

    @property
    def chosen(self) -> Chosen[Any]:
        """The attack with its parameters.

        Raises:
            UserError: if it is unknown or broken, or a parameter is not allowed.
        """
        return choose("attack", self.attack, **self.params)

    def suits(self, victim: object) -> bool:
        """Whether it is meant for a victim."""
        return all(getattr(victim, name, None) == value for name, value in self.victims.items())

    def __str__(self) -> str:
        values = ", ".join(f"{name}={value}" for name, value in self.params.items())
        return f"{self.attack}({values})" if values else self.attack


@dataclass(frozen=True, kw_only=True)
class Suite:
    """A list of attacks with a version; it is never changed, a new list gets a new version.

    Args:
        name: name of its entry point, such as `standard-2`.
        track: track of the victims.
        meaning: one sentence.
        access: the access that its members need, allowed by default in a run of the suite.
        members: the attacks.
        threat: what else of the threat model is allowed by default, such as {"presence.hidden": 9}.
        races: whether its strongest member counts alone, so that the others need not drive all scenarios.
    """

    name: str
    track: str
    meaning: str
    access: Access
    members: tuple[Member, ...]
    threat: Mapping[str, Any] = field(default_factory=dict)
    races: bool = False

    @classmethod
    def read(cls, path: Path) -> Suite:
        """The suite in a TOML file: `track`, `meaning`, `access` and `[[member]]` tables; its name is the file's.

        Raises:
            ValueError: if the file is not a suite; the message is one line.
        """
        try:
            found = tomllib.loads(path.read_text())
            members = tuple(Member(**member) for member in found.pop("member", ()))
            suite = cls(name=path.stem, members=members, **found)
        except (tomllib.TOMLDecodeError, TypeError) as error:
            raise ValueError(f"{path.name} is not a suite: {error}") from None
        if not VERSIONED.fullmatch(suite.name) or not members:
            raise ValueError(f"{path.name} is not a suite: it needs a name that ends in -VERSION, and members")
        return suite

    def pairs(self, **parts: Any) -> tuple[list[Pair], list[str]]:
        """A pair of every member that is meant for the victim, and why the others of these members cannot attack it.

        Args:
            parts: `victim`, `defense`, `world` and `threat` of a `Pair`.
        """
        made, skipped = [], []
        for member in self.members:
            if not member.suits(parts["victim"].component):
                continue
            try:
                given = {**parts, "threat": sets.widened(parts["threat"], member.threat)}
                made.append(Pair(attack=member.chosen, **given))
            except (UserError, ValueError) as error:
                skipped.append(f"{self.name} skips {member}: {error}")
        return made, skipped


def names() -> list[str]:
    """The names of all suites: `standard-2`, and `standard` for the newest version."""
    versioned = list(registry.entries(registry.SUITES))
    return sorted({*versioned, *(_family(name) for name in versioned)})


def suite(name: str, track: str = "") -> Suite:
    """The suite of this name; without a version, the newest: of `NAME-TRACK` if a track is given that has one, else of `NAME`.

    Raises:
        UserError: if there is no such suite, or its entry point is not a suite of that name.
    """
    for family in (f"{name}-{track}", name):
        if known := _versions(family):
            break
    newest = known[-1] if known else name
    found = registry.resolve(registry.SUITES, newest, "suite")
    if not isinstance(found, Suite) or found.name != newest:
        raise UserError(f"suite {newest!r} is not a cavbench.core.suites.Suite with that name")
    return found


def versions(family: str) -> list[Suite]:
    """Every version of a suite, the oldest first."""
    return [suite(name) for name in _versions(family)]


def allowed(suites: Sequence[Suite]) -> dict[str, Any]:
    """What suites allow by default of a threat model beside the access: values by the name that follows `threat.`.

    Raises:
        UserError: if they allow different things.
    """
    told = [suite.threat for suite in suites]
    if any(one != told[0] for one in told):
        named = " and ".join(suite.name for suite in suites)
        raise UserError(f"the suites {named} allow different threat models by default: start one run for each")
    return dict(told[0]) if told else {}


def combined(
    attacks: Sequence[Chosen[Any]], suites: Sequence[Suite], others: Sequence[Mapping[str, Any]]
) -> tuple[list[Pair], list[str]]:
    """The pairs of every attack, and of every member of the suites, with every combination of the other parts.

    Args:
        attacks: attacks chosen by name.
        suites: suites of attacks.
        others: combinations of `defense`, `victim`, `world` and `threat`, as keywords of `Pair`.

    Returns:
        The distinct pairs, and why members of suites are skipped, one line each.

    Raises:
        UserError: if an attack that was chosen by its name does not fit, or no member of a suite does.
    """
    pairs, skipped = [], []
    for parts in others:
        own = [Pair(attack=attack, **parts) for attack in attacks]
        pairs += [pair.clean() if pair.is_clean else pair for pair in own]
        for suite in suites:
            made, left = suite.pairs(**parts)
            pairs += made
            skipped += left
    if not pairs:
        raise UserError(skipped[0] if skipped else f"no member of {suites[0].name} is meant for the victim")
    return list({pair.id: pair for pair in pairs}.values()), list(dict.fromkeys(skipped))


def racing(pairs: Sequence[Pair], attacks: Sequence[Chosen[Any]], suites: Sequence[Suite]) -> frozenset[str]:
    """The pairs that race, by their `id`: members of suites that race, but no attack that was chosen by its name."""
    members = {str(member.chosen) for suite in suites if suite.races for member in suite.members}
    members -= {str(attack) for attack in attacks}
    return frozenset(pair.id for pair in pairs if str(pair.attack) in members)


def _versions(family: str) -> list[str]:
    """The names of all versions of a suite, the oldest first."""
    known = [one for one in registry.entries(registry.SUITES) if _family(one) == family != one]
    return sorted(known, key=_version)


def _family(name: str) -> str:
    match = VERSIONED.fullmatch(name)
    return match["family"] if match else name


def _version(name: str) -> int:
    match = VERSIONED.fullmatch(name)
    return int(match["version"]) if match else 0
