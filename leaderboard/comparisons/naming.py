"""Short names of components: with the parameters that tell them apart, and no others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Sequence

from cavbench.leaderboard.comparisons.comparison import Comparison, parameters

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

    It is the name with the parameters in which components of this name differ, without those that most episodes have. Where
    that would be the same for two components, it has the parameters in which these differ.

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

    def label(key: tuple[object, object], always: Container[str] = ()) -> str:
        component_name, params = key
        words = [
            f"{name}={value}"
            for name, value in parameters(params).items()
            if name in names.get(component_name, ())
            and value != ""
            and (name in always or usual.get((component_name, name)) != repr(value))
        ]
        return " ".join([str(component_name), *words])

    keys = {(one.identity[column], one.identity[f"{column}_params"]) for one in comparisons}
    found = {key: label(key) for key in keys}
    for shared in (text for text, count in Counter(found.values()).items() if count > 1):
        alike = [key for key in keys if found[key] == shared]
        sets = [parameters(params) for _, params in alike]
        # A parameter that is not known of all, because some records are older, tells nothing.
        common = set.intersection(*map(set, sets))
        differing = {name for name in common if len({repr(each[name]) for each in sets}) > 1}
        found |= {key: label(key, differing) for key in alike}
    return found
