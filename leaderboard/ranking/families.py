"""Attacks that differ in one thing: the budget of the perturbation, or how much effort they spend."""

from __future__ import annotations

from collections.abc import Sequence

from cavbench.leaderboard.comparisons.comparison import Comparison


def efforts(attacks: Sequence[Comparison]) -> list[list[Comparison]]:
    """Attacks that differ in one number of their own, or in the queries they may spend, by the queries they did spend."""
    found = []
    names = sorted({name for attack in attacks for name in _numbers(attack)})
    for name in names:
        for family in _families(attacks, name):
            ordered = sorted(family, key=lambda attack: (attack.queries, attack.content))
            if ordered[0].queries < ordered[-1].queries:
                found.append(ordered)
    return [*found, *_families(attacks, "threat_queries")]


def budgets(attacks: Sequence[Comparison]) -> list[list[Comparison]]:
    """Attacks that differ in the budget of their perturbation alone, the smallest first."""
    return _families(attacks, "threat_budget")


def _families(attacks: Sequence[Comparison], vary: str) -> list[list[Comparison]]:
    """Those that share every setting but this one, of two or more, in its order."""
    found: dict[frozenset[tuple[str, str]], list[Comparison]] = {}
    for attack in (attack for attack in attacks if vary in attack.settings):
        others = frozenset((name, repr(value)) for name, value in attack.settings.items() if name != vary)
        found.setdefault(others, []).append(attack)

    def value(attack: Comparison) -> tuple[float, tuple[str, ...]]:
        return float(str(attack.settings[vary])), attack.content

    return [sorted(family, key=value) for family in found.values() if len(family) > 1]


def _numbers(attack: Comparison) -> list[str]:
    """The attack's own parameters that are numbers."""
    return [
        name
        for name, value in attack.settings.items()
        if name.startswith("attack.") and isinstance(value, int | float) and not isinstance(value, bool)
    ]
