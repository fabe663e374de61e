"""The remarks of tables, where records are read as comparisons (`cavbench.statistics.doubts` has the words and thresholds)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby

from cavbench.leaderboard.comparisons.comparison import THREAT, Comparison
from cavbench.leaderboard.comparisons.naming import Varying, component, defended, varying
from cavbench.leaderboard.ranking.faults import FaultRow
from cavbench.leaderboard.ranking.worst import Panel, Worst
from cavbench.statistics import doubts
from cavbench.statistics.doubts import OF_VICTIM, Remark
from cavbench.statistics.episodes import Episodes


def comparison_remarks(one: Comparison, about: str = "") -> list[Remark]:
    """What the records of a comparison say against its number."""
    clean = one.clean.table if one.clean else None
    return list(doubts.remarks(one.own.table if one.is_attacked else None, clean, one.track, about))


def run_remarks(comparisons: Sequence[Comparison]) -> list[Remark]:
    """What must stand under a table of these comparisons, of one track."""
    shown = {kind: varying(comparisons, kind) for kind in ("attack", "defense", "victim")}
    found: dict[Remark, None] = {}
    for _, group in groupby(comparisons, key=lambda one: one.defended):
        members = [one for one in group if not one.is_baseline]
        for one in members:
            victim = defended(one, shown)
            attack = f"{component(one, 'attack', shown['attack'])} on " if one.is_attacked else ""
            for remark in comparison_remarks(one):
                about = victim if remark.name in OF_VICTIM else f"{attack}{victim}"
                found[Remark(remark.name, about, remark.text)] = None
        if members:
            one = members[0]
            found |= dict.fromkeys(
                doubts.of_runs(len(one.own.runs), one.track, defended(one, shown), trained=one.trained)
            )
        found |= dict.fromkeys(above_members([one for one in members if one.is_attacked], shown))
    tables = {id(each): each.table for one in comparisons for name, each in one.baselines.items() if not _attack(each)}
    found |= dict.fromkeys(doubts.of_baselines(list(tables.values()), comparisons[0].track))
    return list(found)


def above_members(attacks: Sequence[Comparison], shown: dict[str, Varying]) -> Iterator[Remark]:
    """A remark where the strongest attack of each cell leaves a higher score than one of the attacks does."""
    if len(attacks) > 1 and len({str([one.identity[name] for name in (*THREAT, "grid")]) for one in attacks}) == 1:
        worst = Panel.of(attacks).strongest()
        if worst:
            yield from above(worst, defended(attacks[0], shown))


def above(worst: Worst, about: str) -> Iterator[Remark]:
    """The same of a score that is computed already."""
    whole = [one for one in worst.panel.attacks if set(worst.cells) <= set(one.cells)]
    shown = varying(whole, "attack")
    members = {
        component(one, "attack", shown): float(
            one.scores[one.own.places(worst.runs, worst.cells, worst.panel.seeds)].mean()
        )
        for one in whole
    }
    if members:
        yield from doubts.above_members(worst.score.estimate, members, about)


def row_remarks(worst: Worst) -> list[Remark]:
    """What a reader must know of the score of a defended victim under its strongest attacks, besides the flags."""
    one = worst.most
    found = [
        *above(worst, ""),
        *_raced(worst.panel),
        *doubts.of_victim(one.own.table, one.clean.table if one.clean else None, one.track),
        *doubts.of_runs(len(worst.runs), one.track, trained=worst.trained),
    ]
    return list(dict.fromkeys(found))


def _raced(panel: Panel) -> Iterator[Remark]:
    """A remark where attacks were dropped from a race."""
    if panel.pilot:
        dropped, every = len(panel.pilot.attacks) - len(panel.attacks), len(panel.pilot.attacks)
        yield Remark(
            "raced",
            "",
            f"{dropped} of {every} attacks were dropped from a race after {len(panel.pilot.seeds)} scenarios a cell; the score "
            f"may be too high by up to {panel.hidden:.3f} for it, which its lower bound allows for",
        )


def fault_remarks(faults: FaultRow | None, worst: Worst) -> Iterator[Remark]:
    """A remark where faults were driven on fewer runs, cells or scenarios than the score of the row is of."""
    if faults is None:
        return
    own, wanted = (faults.runs, faults.cells, faults.scenarios), (len(worst.runs), *worst.shape)
    if any(few < many for few, many in zip(own, wanted, strict=True)):
        nouns = (worst.most.track.run, "cell", "scenario")
        driven = " x ".join(f"{count} {noun}{'s' * (count != 1)}" for count, noun in zip(own, nouns, strict=True))
        yield Remark("few_faults", "", f"its columns of faults are of {driven} for each fault, fewer than its score")


def _attack(episodes: Episodes) -> bool:
    return bool(episodes.table["attack"][0].as_py() != "none")
