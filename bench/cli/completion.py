"""Shell completion of `KEY=VALUE` options, from the entry points alone: nothing is imported that takes long."""

from __future__ import annotations

import os
from collections.abc import Iterator


def completed(incomplete: str) -> list[str]:
    """The options that begin with what was typed: keys, then the values of a key, also after a comma.

    Args:
        incomplete: the word that is being typed, for instance `attack=no` or `attack=noise,p`.
    """
    before = _words_before()
    if incomplete == "=" or before[-1:] == ["="]:
        # Bash splits words at "=", and replaces only what follows it.
        key = before[-1 if incomplete == "=" else -2]
        return [word.removeprefix(f"{key}=") for word in _fitting(f"{key}={incomplete.removeprefix('=')}")]
    return _fitting(incomplete)


def _words_before() -> list[str]:
    """The words before the one that is being typed, as bash splits them; empty for other shells."""
    place = os.environ.get("COMP_CWORD", "")
    return os.environ.get("COMP_WORDS", "").split()[: int(place)] if place.isdecimal() else []


def _fitting(incomplete: str) -> list[str]:
    key, equals, value = incomplete.partition("=")
    if not equals:
        known = [*known_keys(), *(_of_sets() if key.startswith("threat.") else ())]
        return [f"{each}=" for each in known if each.startswith(key)]
    before, comma, last = value.rpartition(",")
    return [f"{key}={before}{comma}{known}" for known in _values(key) if known.startswith(last)]


def known_keys() -> list[str]:
    """The keys of `bench run`, without the parameters of components."""
    from cavbench.cli.options_help import settings
    from cavbench.core import registry
    from cavbench.run.options import RunOptions

    axes = dict.fromkeys(axis for grid in registry.all_grids() for axis in grid.axes)
    threat = [f"threat.{name}" for name in ("norm", "budget", "access", "queries", "share")]
    return [*registry.KINDS, *axes, *threat, *(name for name, _, _ in settings(RunOptions))]


def _of_sets() -> Iterator[str]:
    """`threat.presence.hidden` and its like, of all tracks; reading them takes a moment."""
    from dataclasses import fields

    from cavbench.core.track import tracks

    for track in tracks():
        for name, kind in track.sets.items():
            yield from (f"threat.{name}.{item.name}" for item in fields(kind))


def _values(key: str) -> Iterator[str]:
    from cavbench.core import registry, suites

    for kind in registry.KINDS:
        if key == kind:
            yield from registry.names(kind)
            yield from suites.names() if kind == "attack" else ()
    for grid in registry.all_grids():
        yield from [grid.name] if key == "grid" else []
        axis = grid.axes.get(key)
        if axis is not None:
            yield from map(str, axis.choices)
    yield from {"reference": ("true", "false"), "threat.norm": ("relative", "linf")}.get(key, ())
