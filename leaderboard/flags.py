"""What casts doubt on a row of a leaderboard, each from a measurement of the runs themselves (docs/leaderboard.md).

A flag fires, does not fire, or says that it was not measured; it never guesses.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow.compute as pc

from bench.plugins.contracts import Track
from bench.scenarios import Grid
from bench.statistics.estimates import Interval
from leaderboard.entries import Entry, gap, mean
from leaderboard.trend import ENOUGH_SEEDS
from leaderboard.worst import Worst, margin, worst

ENOUGH_EPISODES: dict[Track, int] = {"driving": 20, "detection": 3}
"""Scenarios a cell below which a score is flagged."""
NOTHING_LEFT = 0.01
"""A score this low cannot be lowered: attacks that leave no more are not told apart."""
STILL_FALLING = 0.02
"""A curve that falls by more than this with its last increase has not flattened."""
SAME, MASKED, DRAWN, ONE_DRAW = 0.99, 0.5, 0.01, 2.0
"""Shares of probes: from which answers hang on no input, gradients are masked, a victim draws; and questions a point that are
too few for one that does."""


@dataclass(frozen=True)
class Flag:
    """A doubt, or that there is none.

    Args:
        name: a key of `FLAGS`.
        fired: None where it was not measured.
        reason: the measurement in one sentence.
    """

    name: str
    fired: bool | None
    reason: str


@dataclass(frozen=True, eq=False)
class Subject:
    """What flags are raised on: a defended victim in a threat model.

    Args:
        track: its.
        entries: the attacks that count.
        others: all attacks under the same norm, of larger budgets too.
        worst: what the strongest of them leaves in each cell.
    """

    track: Track
    entries: Sequence[Entry]
    others: Sequence[Entry]
    worst: Worst

    def strongest(self, *knowledge: str) -> Worst | None:
        """What the attacks that asked so much leave, the strongest in each cell."""
        some = [entry for entry in self.entries if entry.knowledge in knowledge]
        return worst(some) if some else None

    def shares(self, name: str) -> float:
        """Mean of a probe over all its episodes, under attack and without; NaN where none was measured."""
        tables = [entry.own.table for entry in self.entries]
        tables += [entry.clean.table for entry in self.entries if entry.clean]
        found = [value for table in tables if not math.isnan(value := mean(table, name))]
        return sum(found) / len(found) if found else math.nan


Finding = tuple[bool | None, str]


def unattacked(of: Subject) -> Finding:
    """Fires where every attack that was run asked the victim nothing: such a score is one under noise."""
    if of.strongest("answers", "gradients", "unknown"):
        return False, f"{sum(entry.knowledge != 'nothing' for entry in of.entries)} attacks asked the victim."
    return True, "No attack that asks the victim anything was run: this is a score under noise."


def masked_gradients(of: Subject) -> Finding:
    """Fires where an attack without gradients leaves less than the best one with them: gradients that mislead are no defence."""
    white, black = of.strongest("gradients"), of.strongest("answers", "nothing")
    if any(entry.knowledge == "unknown" for entry in of.entries):
        return None, "Not measured: these records are older than the count of gradients."
    if white is None or black is None:
        return None, f"Not measured: no {'white' if white is None else 'black'}-box attack was run."
    found = margin(white, black)
    if found is None:
        return None, "Not measured: the black-box and the white-box attack share no scenario."
    names = f"{_leaves(black)} (black box), {_leaves(white)} (white box)"
    return found.low > 0, f"{names}; the difference is {_signed(found)}."


def noise(of: Subject) -> Finding:
    """Fires where the best attack takes no more than one that asks nothing: the attack is weak, or the victim draws."""
    quiet, asking = of.strongest("nothing"), of.strongest("answers", "gradients", "unknown")
    if quiet is None or asking is None:
        return None, f"Not measured: no {'noise' if quiet is None else 'attack beside noise'} was run."
    found = margin(quiet, asking)
    if found is None:
        return None, "Not measured: noise and attack share no scenario."
    names = f"{_leaves(quiet)}, {_leaves(asking)}"
    if quiet.score.estimate <= NOTHING_LEFT:
        return False, f"{names}: noise leaves nothing that an attack could take."
    return found.low <= 0, f"{names}; what the attack takes beyond noise is {_signed(found)}."


def blind(of: Subject) -> Finding:
    """Fires where the score under attack is not significantly above that of the best policy that ignores its input."""
    if of.worst.lead is None:
        none = "a detector has no blind policy" if of.track == "detection" else "the blind policies were not driven"
        return None, f"Not measured: {none}."
    return (
        of.worst.lead.low <= 0,
        f"Under attack it scores {_signed(of.worst.lead)} against the best policy that does not look.",
    )


def ignores_input(of: Subject) -> Finding:
    """Fires where the victim answers the same on another input in at least 99 % of probes."""
    share = of.shares("same_answer")
    if math.isnan(share):
        return None, "Not measured: these records are older than the probes of the input."
    other = "another episode's observation" if of.track == "driving" else "a grey picture"
    return share >= SAME, f"On {other} it answered the same in {100 * share:.1f} % of probes."


def zero_gradients(of: Subject) -> Finding:
    """Fires where at least half of the gradients that an attack took were zero everywhere."""
    shares = [share for entry in of.entries if not math.isnan(share := entry.mean("zero_gradients"))]
    if not shares:
        return None, "Not measured: no attack took gradients, or the records are older than their count."
    return max(shares) >= MASKED, f"{100 * max(shares):.0f} % of the gradients an attack took were zero everywhere."


def one_draw(of: Subject) -> Finding:
    """Fires where the victim answers otherwise when asked again, and no attack asked about each observation twice."""
    redrawn = of.shares("redrawn")
    if math.isnan(redrawn):
        return None, "Not measured: these records are older than the probes of randomness."
    if redrawn < DRAWN:
        return False, "Asked the same twice, it gave the same answer: nothing is drawn."
    if of.track == "detection":
        return False, "It draws, and a patch is crafted on many pictures, each a draw of its own."
    draws = max((value for entry in of.entries if not math.isnan(value := entry.mean("draws"))), default=0.0)
    asked = f"the most patient attack asked {draws:.1f} times about each observation"
    return draws < ONE_DRAW, f"Asked the same twice, it answered otherwise in {100 * redrawn:.0f} % of probes; {asked}."


def no_fall(of: Subject) -> Finding:
    """Fires where the largest perturbation budget takes no more than the smallest, by the same attack."""
    found = []
    for family in _families(of.others, "threat_budget"):
        small, large = family[0], family[-1]
        change = gap(small, large)
        if change:
            found.append((large.score.estimate, small, large, change))
    if not found:
        return None, "Not measured: no attack was run with two budgets."
    _, small, large, change = min(found, key=lambda one: one[0])
    budgets = f"from budget {small.identity['threat_budget']:g} to {large.identity['threat_budget']:g} {large.identity['attack']}"
    if small.score.estimate <= NOTHING_LEFT:
        return False, f"At the smallest budget {small.identity['attack']} leaves nothing."
    return change.low <= 0, f"The score falls by {_signed(change)} {budgets}."


def not_flattened(of: Subject) -> Finding:
    """Fires where the last increase of an attack's steps, restarts or queries still took more than 0.02."""
    found = [
        (family[-1].score.estimate, family[-2], family[-1], change)
        for family in efforts(of.entries)
        if (change := gap(family[-2], family[-1]))
    ]
    if not found:
        return None, "Not measured: no attack was run with two efforts."
    _, less, more, change = min(found, key=lambda one: one[0])
    fired = change.low > 0 and change.estimate > STILL_FALLING
    return (
        fired,
        f"From {less.queries:.0f} to {more.queries:.0f} queries {more.identity['attack']} takes {_signed(change)} more.",
    )


def too_little(of: Subject) -> Finding:
    """Fires below 3 seeds, 20 scenarios a cell (3 approaches), or where cells of the standard grid are missing."""
    runs, _, episodes = of.worst.scores.shape
    weights = {value for entry in of.entries for value in pc.unique(entry.own.table["weights_sha256"]).to_pylist()}
    seeded = of.track == "detection" or bool(weights - {""})
    grid = _grid(of)
    cells = len(set(grid.cells()) & set(of.worst.cells))
    what = f"{runs} seed{'s' * (runs != 1)}, {cells} of {len(grid.cells())} cells of {grid.name}, {episodes} scenarios each"
    few = (seeded and runs < ENOUGH_SEEDS) or episodes < ENOUGH_EPISODES[of.track] or cells < len(grid.cells())
    return few, f"It was driven with {what}."


FLAGS: dict[str, tuple[str, Callable[[Subject], Finding]]] = {
    "unattacked": ("attacked by noise alone", unattacked),
    "blind": ("no better than a blind policy", blind),
    "ignores_input": ("the answer does not depend on the input", ignores_input),
    "masked_gradients": ("a black-box attack beats the white-box one", masked_gradients),
    "zero_gradients": ("gradients are zero", zero_gradients),
    "noise": ("random noise does as much as the attack", noise),
    "one_draw": ("random, and attacked with one draw", one_draw),
    "no_fall": ("the score does not fall as the budget grows", no_fall),
    "not_flattened": ("more effort would still lower the score", not_flattened),
    "too_little": ("too few seeds, scenarios or cells", too_little),
}
"""Every flag: what it says where it fires, and its measurement."""


def flags(of: Subject) -> Iterator[Flag]:
    """Every flag of a defended victim, fired or not."""
    for name, (_, find) in FLAGS.items():
        yield Flag(name, *find(of))


def efforts(entries: Sequence[Entry]) -> list[list[Entry]]:
    """Attacks that differ in one number of their own, or in the queries they may spend, by the queries they did spend."""
    found = []
    names = sorted({name for entry in entries for name in _numbers(entry)})
    for name in names:
        for family in _families(entries, name):
            ordered = sorted(family, key=lambda entry: entry.queries)
            if ordered[0].queries < ordered[-1].queries:
                found.append(ordered)
    return [*found, *_families(entries, "threat_queries")]


def budgets(entries: Sequence[Entry]) -> list[list[Entry]]:
    """Attacks that differ in the budget of their perturbation alone, the smallest first."""
    return _families(entries, "threat_budget")


def _families(entries: Sequence[Entry], vary: str) -> list[list[Entry]]:
    """Those that share every setting but this one, of two or more, in its order."""
    found: dict[frozenset[tuple[str, str]], list[Entry]] = {}
    for entry in (entry for entry in entries if vary in entry.settings):
        others = frozenset((name, repr(value)) for name, value in entry.settings.items() if name != vary)
        found.setdefault(others, []).append(entry)

    def value(entry: Entry) -> float:
        return float(str(entry.settings[vary]))

    return [sorted(family, key=value) for family in found.values() if len(family) > 1]


def _numbers(entry: Entry) -> list[str]:
    """The attack's own parameters that are numbers."""
    return [
        name
        for name, value in entry.settings.items()
        if name.startswith("attack.") and isinstance(value, int | float) and not isinstance(value, bool)
    ]


def _grid(of: Subject) -> Grid:
    named = {name for entry in of.entries for name in pc.unique(entry.own.table["grid"]).to_pylist()}
    own = [grid for grid in GRIDS.values() if grid.track == of.track]
    return next((grid for grid in own if grid.name in named), own[0])


def _leaves(found: Worst) -> str:
    return f"{found.name} leaves {found.score.estimate:.2f}"


def _signed(found: Interval) -> str:
    numbers = (
        f"{found.estimate:+.2f} [{found.low:+.2f}, {found.high:+.2f}]"
        if np.isfinite(found.low)
        else f"{found.estimate:+.2f}"
    )
    return numbers.replace("-", "−")
