"""Which networks of the zoo were trained in a world."""

from __future__ import annotations

import re
from collections.abc import Iterator

from cavbench import bounded
from cavbench.errors import UserError
from cavbench.zoo.recipe import DIGITS, Recipe
from cavbench.zoo.store import roots


def trained_there(recipe: Recipe, where: str) -> list[str]:
    """The options that choose the networks of a recipe's name that were trained in a world: `victim.trained_in=merge`.

    Args:
        recipe: any recipe of this name.
        where: the world in the format of `trained_in`.
    """
    return sorted({" ".join(options) for options in _options(recipe, where)})


def _options(recipe: Recipe, where: str) -> Iterator[list[str]]:
    for path in (path for root in roots() for path in root.glob(f"{recipe.name}-*/seed*.json")):
        if not re.fullmatch(f"{re.escape(recipe.name)}-[0-9a-f]{{{DIGITS}}}", path.parent.name):
            continue
        try:
            made = bounded.read_json(path, finite=False)["recipe"]
            changed = {part.kind: made[part.kind]["changed"] for part in recipe.parts}
            if changed[recipe.trained.kind].get("trained_in") == where:
                yield [f"{kind}.{name}={value}" for kind, values in changed.items() for name, value in values.items()]
        except (UserError, KeyError, TypeError, AttributeError):
            # A card that cannot be read is no choice. `bench train` and loading say what is wrong with it.
            continue
