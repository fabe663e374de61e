"""What somebody types to get a component: its parameters without the defaults."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

from cavbench.core import registry
from cavbench.core.outline import outline
from cavbench.core.parameters import parameters
from cavbench.core.registry import Kind
from cavbench.core.sources import defaults_of


def typed(kind: Kind, name: str, params: Mapping[str, object]) -> dict[str, object]:
    """The parameters without those that are the defaults, which nobody types.

    An empty one is typed where it is not the default. Those of a link of a chain are `LINK.NAME`.
    """
    found = {}
    for key, value in params.items():
        link, _, own = key.rpartition(".")
        defaults = _defaults(kind, link or name.partition(":")[0])
        if own not in defaults or repr(_plain(defaults[own])) != repr(value):
            found[key] = value
    return found


@cache
def _defaults(kind: Kind, name: str) -> dict[str, object]:
    """The defaults of a component; of a plug-in's those that its source writes out, because nothing is imported."""
    if found := outline(kind, name):
        return {key: one.default for key, one in parameters(found).items()}
    claims = registry.entries(registry.GROUPS[kind]).get(name, ())
    return defaults_of(claims[0].target) if len(claims) == 1 else {}


def _plain(value: object) -> object:
    """A default as the JSON of a record has it."""
    return list(map(_plain, value)) if isinstance(value, tuple) else value
