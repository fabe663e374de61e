"""A component may not change while it is measured: what an attack remembers belongs into its state."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from cavbench.isolation.custody import Custody, listed
from cavbench.isolation.framework import OWN
from cavbench.isolation.watch import Side, TamperError


@contextmanager
def unchanged(components: Mapping[str, object], *sides: Side, arrays: bool = False) -> Iterator[None]:
    """Refuse components that change meanwhile, and put them back.

    Args:
        components: by the name that the message uses.
        sides: whose they are.
        arrays: whether only the arrays in them may not change.

    Raises:
        TamperError: if an attribute, or anything in it, was changed, added or removed.
    """
    packages = {OWN, *(type(component).__module__.partition(".")[0] for component in components.values())}
    custody = Custody(components, packages, functions=False, arrays=arrays)
    try:
        yield
    finally:
        names = custody.changed()
        custody.restore()
    if names:
        raise TamperError(
            f"{listed(names)} changed while it was measured: keep what is remembered in the state", *sides
        )
