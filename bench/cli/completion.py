"""Shell completion of `KEY=VALUE` options, from the entry points alone: nothing is imported that takes long."""

from __future__ import annotations

from collections.abc import Iterator


def completed(args: list[str], incomplete: str) -> list[str]:
    """The options that begin with what was typed: keys, then the values of a key, also after a comma.

    Args:
        args: the words before; bash splits words at `=`, so the last ones may be a key and `=`.
        incomplete: the word that is being typed, for instance `attack=no` or `attack=noise,p`.
    """
    if incomplete == "=" or args[-1:] == ["="]:
        key = args[-1 if incomplete == "=" else -2]
        typed = f"{key}={incomplete.removeprefix('=')}"
        return [word.removeprefix(f"{key}=") for word in completed([], typed)]
    key, equals, value = incomplete.partition("=")
    if not equals:
        return [f"{known}=" for known in _keys() if known.startswith(key)]
    before, comma, last = value.rpartition(",")
    return [f"{key}={before}{comma}{known}" for known in _values(key) if known.startswith(last)]


def _keys() -> list[str]:
    from bench.plugins import registry

    axes = dict.fromkeys(axis for grid in registry.all_grids() for axis in grid.axes)
    threat = [f"threat.{name}" for name in ("norm", "budget", "access", "queries", "share")]
    settings = ["grid", "episodes", "seeds", "executor", "workers", "out", "record", "reference"]
    return [*registry.KINDS, *axes, *threat, *settings]


def _values(key: str) -> Iterator[str]:
    from bench.plugins import registry, suites

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
