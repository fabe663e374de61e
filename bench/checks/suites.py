"""Selects and runs the suites of a component."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from cavbench.checks import kits
from cavbench.checks.check import NotApplicableError, Outcome, Subject, Suite, one_line
from cavbench.checks.component import ComponentSuite
from cavbench.checks.scenarios import ScenarioSuite
from cavbench.core import sources
from cavbench.core.contracts import ANY_TRACK
from cavbench.core.options import configured
from cavbench.core.pair import choose
from cavbench.core.registry import Kind
from cavbench.core.track import track
from cavbench.errors import UserError


def examine(
    kind: Kind, name: str, values: Mapping[str, str] | None = None, *, victim: str = "", world: str = ""
) -> Iterator[Outcome]:
    """Run every check of a component, and yield the outcomes in order.

    Args:
        kind: attack, defense, victim or world.
        name: registered name.
        values: its parameters, as on the command line.
        victim: name of the victim for a defence or an attack that learns; empty for the first that it can be loaded for.
        world: name of the world to check in; empty for the default world of the track.

    Raises:
        UserError: if the plug-in is broken, or a parameter is not allowed.
    """
    subject = Subject(kind=kind, name=name, component=configured(kind, name, values or {}).component)
    yield from ComponentSuite(subject).outcomes()
    if kind == "world":
        yield from ScenarioSuite(subject).outcomes()
    served = subject.component.tracks()
    served = tuple(kits.kits()) if served == (ANY_TRACK,) else served
    for track_name in served:
        prefix = f"{track_name}: " if len(served) > 1 else ""
        for outcome in _behaviour(subject, track_name, victim, world):
            yield replace(outcome, check=f"{prefix}{outcome.check}")


def complaints(kind: Kind, name: str, **values: str) -> list[str]:
    """What to fix in a component, one line each; the tests of a plug-in assert that the list is empty.

    Args:
        kind: attack, defense, victim or world.
        name: registered name; the package must be installed.
        values: its parameters, as on the command line.

    Raises:
        UserError: if the plug-in is broken or a parameter is not allowed.
    """
    found = examine(kind, name, values)
    return [f"{outcome.check}: {outcome.text}" for outcome in found if outcome.status == "fail"]


def _behaviour(subject: Subject, track_name: str, victim: str, world: str) -> Iterator[Outcome]:
    """Run the suites of a track."""
    try:
        suites = list(_suites(subject, track_name, victim, world))
    except NotApplicableError as reason:
        yield Outcome("behaviour", "skip", one_line(reason))
        return
    # Loading third-party code may raise anything.
    except Exception as error:
        yield Outcome("behaviour", "fail", f"{type(error).__name__}: {one_line(error)}")
        return
    for suite in suites:
        yield from suite.outcomes()


def _suites(subject: Subject, track_name: str, victim: str, world: str) -> Iterator[Suite]:
    """The suites of a track's kit for a component; victims and defences are loaded first."""
    kit = kits.kit(track_name)
    if kit is None or subject.kind not in kit.suites:
        raise NotApplicableError(
            f"the track {track_name!r} has no checks for this kind of component (entry point {kits.KITS})"
        )
    if subject.kind != "world":
        own = getattr(subject.component, "made_for", "")
        tried_in = choose("world", world or own or track(track_name).world).component
        if not tried_in.serves(track_name):
            raise NotApplicableError(f"world {world!r} belongs to another track")
        subject = replace(subject, world=tried_in)
    if subject.kind == "victim":
        subject = replace(subject, victim=subject.component)
        _require_loadable(subject)
    if subject.kind == "defense":
        subject = _with_victim(subject, victim, track_name)
    if subject.kind == "attack" and subject.component.learns:
        subject = _with_adversary(subject, victim, track_name)
    yield from kit.suites[subject.kind](subject)


def _require_loadable(subject: Subject) -> None:
    """Raise NotApplicableError if a victim cannot be loaded, for instance because it is not trained yet."""
    try:
        subject.load()
    except UserError as error:
        raise NotApplicableError(f"it cannot be loaded: {one_line(error)}") from None


def _with_victim(subject: Subject, name: str, track_name: str) -> Subject:
    """The subject with a victim for the defence: the named one, or the first that the defence can be loaded for."""
    reasons = []
    for victim in [choose("victim", name).component] if name else _victims(track_name):
        if not victim.serves(track_name):
            raise NotApplicableError(f"victim {name!r} belongs to another track")
        tried = replace(subject, victim=victim)
        try:
            tried.load()
            return tried
        except UserError as error:
            reasons.append(one_line(error))
    raise NotApplicableError(f"it cannot be loaded for any victim: {reasons[0] if reasons else 'none is installed'}")


def _with_adversary(subject: Subject, name: str, track_name: str) -> Subject:
    """The subject with the network of an attack that learns, for the named victim or the first that it is trained for."""
    nothing = choose("defense", "none").component
    reasons = []
    for victim in [choose("victim", name).component] if name else _victims(track_name):
        if subject.component.misfit(victim):
            continue
        try:
            adversary = subject.component.load(victim, nothing, 0, subject.world.facts)
            return replace(subject, component=subject.component.armed(adversary), victim=victim)
        except UserError as error:
            reasons.append(one_line(error))
    raise NotApplicableError(f"it cannot be loaded for any victim: {reasons[0] if reasons else 'none is installed'}")


def _victims(track_name: str) -> Iterator[Any]:
    """The victims of a track that use their input and need no parameters."""
    for name in sources.names("victim", track_name):
        try:
            victim = choose("victim", name).component
        except UserError:
            continue
        if victim.sees:
            yield victim
