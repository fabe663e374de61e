"""Names the component that failed, with the package and version that ship it."""

from __future__ import annotations

import traceback
from collections.abc import Sequence
from typing import Any

from cavbench.core.pair import Chosen, Pair
from cavbench.errors import RefusedNetworkError
from cavbench.run.unit import is_foreign

SIDES = {"attack": ("attack",), "defense": ("defense", "victim")}
"""The kinds of component on each side of a `cavbench.isolation.watch.TamperError`."""


def blamed(pair: Pair, error: BaseException | None = None) -> str:
    """The components that may have failed, in parentheses with their packages; empty if no plug-in takes part and none is named.

    Args:
        pair: the pair that was driven.
        error: what was raised; None if the process did not live to raise anything. The component whose code raised it is named
            alone; without one, all plug-ins of the pair.
    """
    sides = [kind for side in getattr(error, "sides", ()) for kind in SIDES[side]]
    parts = [part for part in pair.parts if part.kind in sides]
    if isinstance(error, RefusedNetworkError):
        # Whichever part of the network it is, its user knows the objects that he gave.
        parts = [part for part in (pair.defense, pair.victim) if is_foreign(part) and not part.code]
    else:
        parts = parts or (_raised_by(pair, error) if error else []) or [part for part in pair.parts if is_foreign(part)]
    return named(parts)


def named(parts: Sequence[Chosen[Any]]) -> str:
    """Some components in parentheses, with their packages; empty for none."""
    packages: dict[str, list[str]] = {}
    for part in parts:
        packages.setdefault(part.shipped_by, []).append(f"{part.kind} {part.name!r}")
    found = " and ".join(f"{', '.join(components)} of {package}" for package, components in packages.items())
    return f" ({found})" if found else ""


def _raised_by(pair: Pair, error: BaseException) -> list[Chosen[Any]]:
    """The components in whose module the innermost frame of the traceback is; those of its class, if there are any."""
    frames = [frame for cause in _causes(error) for frame, _ in traceback.walk_tb(cause.__traceback__)]
    for frame in reversed(frames):
        module = frame.f_globals.get("__name__", "")
        parts = [part for part in pair.parts if _owns(part, module)]
        owner = frame.f_code.co_qualname.partition(".")[0]
        if parts:
            return [part for part in parts if type(part.component).__name__ == owner] or parts
    return []


def _causes(error: BaseException) -> list[BaseException]:
    """The exception and what caused it, the last cause at the end."""
    found = [error]
    while (cause := found[-1].__cause__) is not None and cause not in found:
        found.append(cause)
    return found


def _owns(part: Chosen[Any], module: str) -> bool:
    """Whether a module is the component's, or in the package of its plug-in."""
    own = type(part.component).__module__
    return module == own or (is_foreign(part) and module.partition(".")[0] == own.partition(".")[0])
