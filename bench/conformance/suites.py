"""Which suites a component has to pass, and their outcomes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

from bench.conformance.check import NotApplicableError, Outcome, Suite, one_line
from bench.conformance.component import ComponentSuite
from bench.errors import UserError
from bench.plugins import sources as tracks
from bench.plugins.contracts import Track
from bench.plugins.options import WORLDS, configured
from bench.plugins.pair import choose
from bench.plugins.registry import Kind


def examine(kind: Kind, name: str, values: Mapping[str, str] | None = None, victim: str = "") -> Iterator[Outcome]:
    """The outcome of every check of a component, in order, as they come.

    Args:
        kind: attack, defense, victim or world.
        name: it is registered by.
        values: its parameters, as on the command line.
        victim: that a defence is tried on; empty for the first that it can be loaded for.

    Raises:
        UserError: if the plug-in is broken, a parameter is not allowed, or the victim does not fit.
    """
    component = configured(kind, name, values or {}).component
    served = component.tracks()
    yield from ComponentSuite(name, component, kind).outcomes()
    for track in served:
        prefix = f"{track}: " if len(served) > 1 else ""
        try:
            suite = SUITES[kind, track](name, component, victim)
        except NotApplicableError as reason:
            yield Outcome(f"{prefix}behaviour", "skip", one_line(reason))
            continue
        # Third-party code may fail in any way, while it is loaded too.
        except Exception as error:
            yield Outcome(f"{prefix}behaviour", "fail", f"{type(error).__name__}: {one_line(error)}")
            continue
        for outcome in suite.outcomes():
            yield Outcome(f"{prefix}{outcome.check}", outcome.status, outcome.text)


def complaints(kind: Kind, name: str, **values: str) -> list[str]:
    """What a plug-in has to fix, a line each; its own tests assert that there is nothing.

    Args:
        kind: attack, defense, victim or world.
        name: it is registered by: the package must be installed.
        values: its parameters, as on the command line.

    Raises:
        UserError: if the plug-in is broken or a parameter is not allowed.
    """
    found = examine(kind, name, values)
    return [f"{outcome.check}: {outcome.text}" for outcome in found if outcome.status == "fail"]


def _attack(name: str, component: Any, victim: str) -> Suite:
    from bench.conformance.attack import AttackSuite

    return AttackSuite(name, component, _world("driving").features)


def _patch(name: str, component: Any, victim: str) -> Suite:
    from bench.conformance.patch import PatchSuite

    return PatchSuite(name, component)


def _driver(name: str, component: Any, victim: str) -> Suite:
    from bench.conformance.policy import PolicySuite

    _loaded(component.load)
    return PolicySuite(name, component, component, partial(component.load, 0), _world("driving"))


def _detector(name: str, component: Any, victim: str) -> Suite:
    from bench.conformance.detector import DetectorSuite

    _loaded(component.load)
    return DetectorSuite(name, component, component, partial(component.load, 0))


def _defended_driver(name: str, component: Any, victim: str) -> Suite:
    from bench.conformance.policy import PolicySuite

    target = _victim_for(component, victim, "driving")
    return PolicySuite(name, component, target, partial(component.load, target, 0), _world("driving"))


def _defended_detector(name: str, component: Any, victim: str) -> Suite:
    from bench.conformance.detector import DetectorSuite

    target = _victim_for(component, victim, "detection")
    return DetectorSuite(name, component, target, partial(component.load, target, 0))


def _driving_world(name: str, component: Any, victim: str) -> Suite:
    from bench.conformance.world import WorldSuite

    return WorldSuite(name, component)


def _camera_world(name: str, component: Any, victim: str) -> Suite:
    from bench.conformance.camera import CameraSuite

    return CameraSuite(name, component)


SUITES: dict[tuple[Kind, Track], Callable[[str, Any, str], Suite]] = {
    ("attack", "driving"): _attack,
    ("attack", "detection"): _patch,
    ("defense", "driving"): _defended_driver,
    ("defense", "detection"): _defended_detector,
    ("victim", "driving"): _driver,
    ("victim", "detection"): _detector,
    ("world", "driving"): _driving_world,
    ("world", "detection"): _camera_world,
}


def _world(track: Track) -> Any:
    return choose("world", WORLDS[track]).component


def _loaded(load: Callable[[int], object]) -> None:
    """Raise NotApplicableError where there is nothing to load yet: a victim that nobody has trained."""
    try:
        load(0)
    except UserError as error:
        raise NotApplicableError(f"it cannot be loaded: {one_line(error)}") from None


def _victim_for(defense: Any, name: str, track: Track) -> Any:
    """The victim that a defence is tried on: the one that is named, or the first that it can be loaded for."""
    reasons = []
    for target in [choose("victim", name).component] if name else _victims(track):
        if track not in target.tracks():
            raise NotApplicableError(f"victim {name!r} is of another track")
        try:
            defense.load(target, 0)
            return target
        except UserError as error:
            reasons.append(one_line(error))
    raise NotApplicableError(f"it can be loaded for no victim: {reasons[0] if reasons else 'none is installed'}")


def _victims(track: Track) -> Iterator[Any]:
    """Those of a track that look at something and need no words."""
    for name in tracks.names("victim", track):
        try:
            target = choose("victim", name).component
        except UserError:
            continue
        if getattr(target, "sees", True):
            yield target
