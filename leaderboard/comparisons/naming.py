"""Short names of components: with the parameters that tell them apart, and no others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from leaderboard.comparisons.comparison import Comparison, parameters

Varying = dict[object, set[str]]
"""By the name of a component, the parameters that are not the same everywhere."""


def varying(comparisons: Sequence[Comparison], column: str) -> Varying:
    """The parameters that tell components of the same name apart; names whose parameters are all the same are left out."""
    by_name: dict[object, list[dict[str, object]]] = {}
    for one in comparisons:
        by_name.setdefault(one.identity[column], []).append(parameters(one.identity[f"{column}_params"]))
    found: Varying = {}
    for component_name, sets in by_name.items():
        for name in set().union(*sets):
            if len({repr(each.get(name)) for each in sets}) > 1:
                found.setdefault(component_name, set()).add(name)
    return found


def component(one: Comparison, column: str, shown: Varying | None = None) -> str:
    """A component's name with its parameters in `shown` (all of them by default)."""
    found = parameters(one.identity[f"{column}_params"])
    wanted = None if shown is None else shown.get(one.identity[column], ())
    words = [f"{name}={value}" for name, value in found.items() if (wanted is None or name in wanted) and value != ""]
    return " ".join([str(one.identity[column]), *words])


def defended(one: Comparison, shown: dict[str, Varying] | None = None) -> str:
    """The victim, with its defence where it has one."""
    kinds = ("victim", "defense") if one.identity["defense"] != "none" else ("victim",)
    return " + ".join(component(one, kind, shown[kind] if shown else None) for kind in kinds)


def labels(comparisons: Sequence[Comparison], column: str) -> dict[tuple[object, object], str]:
    """A label for each component of a kind, by name and parameters as in the records.

    It is the name with the parameters in which components of this name differ, without those that most episodes have.

    Args:
        comparisons: all that need labels.
        column: `attack`, `defense` or `victim`.
    """
    names = varying(comparisons, column)
    episodes: dict[tuple[object, str], Counter[str]] = {}
    for one in comparisons:
        for name, value in parameters(one.identity[f"{column}_params"]).items():
            counter = episodes.setdefault((one.identity[column], name), Counter())
            counter[repr(value)] += one.own.table.num_rows
    usual = {key: value for key, counts in episodes.items() for value, n in counts.items() if 2 * n > counts.total()}
    found = {}
    for one in comparisons:
        name, params = one.identity[column], one.identity[f"{column}_params"]
        words = [
            f"{key}={value}"
            for key, value in parameters(params).items()
            if key in names.get(name, ()) and value != "" and usual.get((name, key)) != repr(value)
        ]
        found[name, params] = " ".join([str(name), *words])
    return found
