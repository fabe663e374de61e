"""What the components of a unit remember: nothing may pass from one unit to another but what the run itself passes on."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Sequence
from contextlib import suppress
from types import ModuleType
from typing import Any

from cavbench.core.pair import Chosen, Pair
from cavbench.isolation.custody import Custody, forget_computed, listed
from cavbench.isolation.framework import OWN
from cavbench.run.unit import is_foreign


class Keeping:
    """The components of some pairs and the packages of plug-ins, as they are before a task.

    `end` finds what changed, and puts it back:

    - A component, its class or the threat model may not change: `refused` says what did, and whose it is.
    - What else a plug-in's package keeps, such as a cache, is forgotten: `forgotten` names it, `origin` the package. No other
      unit can depend on it.

    Args:
        pairs: attack, defence, victim, world, threat model.
    """

    def __init__(self, pairs: Sequence[Pair]) -> None:
        self._parts = list({id(part.component): part for pair in pairs for part in pair.parts}.values())
        # Objects of Python are the user's own: what else their modules hold is not the run's business.
        self._packages = frozenset(_package(part) for part in self._parts if is_foreign(part) and not part.code)
        self._held = [(part, Custody(_roots(part), (OWN, _package(part)))) for part in self._parts]
        self._threats = Custody({"threat": [pair.threat for pair in pairs]}, (OWN,))
        self._others = Custody(_modules(self._packages), self._packages) if self._packages else None
        self._environment = dict(os.environ) if self._packages else {}
        self.refused: tuple[str, tuple[Chosen[Any], ...]] | None = None
        self.forgotten: tuple[str, ...] = ()
        self.origin = " and ".join(
            sorted({part.shipped_by for part in self._parts if _package(part) in self._packages})
        )

    def end(self) -> Keeping:
        """Find what changed, and put it back."""
        for part, custody in self._held:
            if (names := custody.changed()) and self.refused is None:
                # Whoever reaches the world can have changed it.
                self.refused = f"{listed(names)} changed while it was measured", () if part.kind == "world" else (part,)
            custody.restore()
            if is_foreign(part):
                forget_computed(part.component)
        if self._threats.changed():
            self.refused = self.refused or ("the threat model changed while it was measured", ())
            self._threats.restore()
        if self._others is not None:
            self._forget(self._others)
        return self

    def _forget(self, others: Custody) -> None:
        names = others.changed()
        others.restore()
        changed = {
            key for key in {**self._environment, **os.environ} if self._environment.get(key) != os.environ.get(key)
        }
        for key in changed:
            os.environ.pop(key, None)
            if key in self._environment:
                os.environ[key] = self._environment[key]
        for name, module in _modules(self._packages).items():
            _clear_caches(name, module)
        ships = {_package(part): part.shipped_by for part in self._parts if _package(part) in self._packages}
        kept = {package for package in ships if any(name.partition(".")[0] == package for name in names)}
        self.origin = " and ".join(sorted({ships[package] for package in kept or ships}))
        self.forgotten = tuple(names) + tuple(f"the environment variable {key}" for key in sorted(changed))


def _package(part: Chosen[Any]) -> str:
    """The top-level package of a component."""
    return type(part.component).__module__.partition(".")[0]


def _roots(part: Chosen[Any]) -> dict[str, object]:
    """A component, and its classes; those of the framework are in the custody of `cavbench.isolation.framework`.

    Classes of a Python program are its own.
    """
    own = [cls for cls in type(part.component).__mro__ if cls.__module__.partition(".")[0] == _package(part)]
    foreign = own if is_foreign(part) and not part.code else []
    return {part.name: part.component, **{cls.__qualname__: cls for cls in foreign}}


def _modules(packages: Iterable[str]) -> dict[str, ModuleType]:
    """The imported modules of some packages, by name."""
    wanted = frozenset(packages)
    found = {name: module for name, module in list(sys.modules.items()) if name.partition(".")[0] in wanted}
    return {name: module for name, module in found.items() if isinstance(module, ModuleType)}


def _clear_caches(name: str, module: ModuleType) -> None:
    """Empty what functions of a module have cached (`functools.cache`)."""
    for value in list(vars(module).values()):
        members = vars(value).values() if isinstance(value, type) and value.__module__ == name else ()
        for one in (value, *members):
            if getattr(one, "__module__", None) == name and callable(clear := getattr(one, "cache_clear", None)):
                # Whatever a plug-in calls by this name is its own.
                with suppress(Exception):
                    clear()
