"""The score of a defended victim under the strongest attack of each cell, chosen on other scenarios than it is reported on."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from cavbench.leaderboard.comparisons.comparison import Comparison, of_places
from cavbench.scenarios import Cell
from cavbench.statistics.certificate import certificate
from cavbench.statistics.doubts import mean
from cavbench.statistics.episodes import Episodes
from cavbench.statistics.estimates import Array, Interval, interval, share_interval, task_intervals
from cavbench.statistics.independent import independent
from cavbench.statistics.racing import PILOT_RUNS, PILOT_SCENARIOS, by_the_rule, hidden
from cavbench.statistics.strongest import strongest_of, under


@dataclass(frozen=True, eq=False)
class Panel:
    """The attacks on a defended victim that were driven on the same scenarios.

    Args:
        attacks: [A], those that have at least one whole cell, in the order of their names and parameters.
        runs: training or patch seeds [R].
        cells: [C], those that at least one attack has.
        seeds: scenario seeds [E].
        scores: [A, R, C, E] of the metric, NaN in the cells that an attack does not have.
        failed: [A, R, C, E], whether the episode has the failure of the track; NaN likewise.
        left_out: attacks without a whole cell: those that were driven on other seeds, or on a part of them.
        pilot: in a race (`cavbench.statistics.racing`), all attacks on the seeds after which those of this panel went on alone.
    """

    attacks: tuple[Comparison, ...]
    runs: tuple[int, ...]
    cells: tuple[Cell, ...]
    seeds: tuple[int, ...]
    scores: Array
    failed: Array
    left_out: tuple[Comparison, ...]
    pilot: Panel | None = None

    @classmethod
    def of(cls, attacks: Sequence[Comparison]) -> Panel:
        """The attacks on the training and scenario seeds of one of them: those that keep the most episodes of all attacks.

        An attack counts in the cells in which it has all of these seeds. So a partial run changes nothing, and neither does one
        attack on more training seeds than the others have. Of a race, those that went on count on all their seeds.
        """
        designs = [(one.own.runs, one.own.seeds) for one in attacks if not one.stands_for_all]
        designs = designs or [(one.own.runs, one.own.seeds) for one in attacks]
        ordered = sorted(set(designs), key=lambda design: (-_episodes(attacks, *design), len(design[0]), design))
        found = cls._on(attacks, *ordered[0])
        if not found.left_out and len(ordered) == 1:
            return found
        return next((race for design in ordered if (race := cls._race(attacks, *design))), found)

    @classmethod
    def _race(cls, attacks: Sequence[Comparison], runs: Sequence[int], seeds: Sequence[int]) -> Panel | None:
        """The attacks that have these seeds, if they won a race against those that have the pilot's seeds; else None."""
        first = tuple(runs[:PILOT_RUNS]), tuple(seeds[:PILOT_SCENARIOS])
        on = [one for one in attacks if _covers(one, runs, seeds)]
        if first == (tuple(runs), tuple(seeds)) or sum(_covers(one, *first) for one in attacks) <= len(on):
            return None
        pilot = cls._on(attacks, *first)
        whole = not np.isnan(pilot.scores).any()
        if not whole or not by_the_rule(pilot.scores, [n for n, one in enumerate(pilot.attacks) if one in on]):
            return None
        return replace(cls._on(on, runs, seeds), left_out=pilot.left_out, pilot=pilot)

    @classmethod
    def _on(cls, attacks: Sequence[Comparison], runs: Sequence[int], seeds: Sequence[int]) -> Panel:
        """The attacks on these seeds."""
        whole = sorted((one for one in attacks if _covers(one, runs, seeds)), key=lambda one: one.content)
        cells = sorted({cell for one in whole for cell in one.cells}, key=whole[0].axes.place)
        shape = (len(whole), len(runs), len(cells), len(seeds))
        scores, failed = np.full(shape, np.nan), np.full(shape, np.nan)
        for number, one in enumerate(whole):
            there = [cells.index(cell) for cell in one.cells]
            places = one.own.places(runs, one.cells, seeds)
            scores[number][:, there] = one.scores[places]
            if one.track.failure:
                failed[number][:, there] = one.own.column(one.track.failure)[places]
        left_out = tuple(sorted((one for one in attacks if one not in whole), key=lambda one: one.content))
        return cls(tuple(whole), tuple(runs), tuple(cells), tuple(seeds), scores, failed, left_out)

    @property
    def whole(self) -> Panel:
        """The panel on which all attacks can be compared: in a race, the pilot's."""
        return self.pilot or self

    @cached_property
    def hidden(self) -> float:
        """By how much the score may be too high because attacks were dropped from a race: a bound of 97.5 %; 0 without a race."""
        return hidden(self.pilot.scores) if self.pilot else 0.0

    def strongest(self, attacks: Collection[Comparison] | None = None) -> Worst | None:
        """The score where in each cell the strongest of `attacks` counts; None where none of them has a cell.

        Args:
            attacks: some of those of the panel; None for all.
        """
        some = [n for n, one in enumerate(self.attacks) if attacks is None or one in attacks]
        known = ~np.isnan(self.scores[some, 0, :, 0])
        cells = np.flatnonzero(known.any(0))
        if not len(cells):
            return None
        scores, failed = (values[some][:, :, cells] for values in (self.scores, self.failed))
        own = strongest_of(scores)
        weights = np.zeros((len(self.attacks), *own.shape[1:]))
        weights[some] = own
        return Worst(self, tuple(cells.tolist()), weights, under(own, scores), under(own, failed), tuple(some))

    def marginal(self, worst: Worst) -> dict[Comparison, Interval]:
        """By how much each attack lowers the score further than all the others do together; `worst` is that of all.

        In a race, in its pilot.
        """
        if self.pilot:
            every = self.pilot.strongest()
            return self.pilot.marginal(every) if every else {}
        found: dict[Comparison, Interval] = {}
        for attack in self.attacks:
            rest = self.strongest([one for one in self.attacks if one is not attack])
            change = margin(rest, worst) if rest else None
            if change:
                found[attack] = change
        return found


def _covers(attack: Comparison, runs: Sequence[int], seeds: Sequence[int]) -> bool:
    return set(seeds) <= set(attack.own.seeds) and (attack.stands_for_all or set(runs) <= set(attack.own.runs))


def _episodes(attacks: Sequence[Comparison], runs: Sequence[int], seeds: Sequence[int]) -> int:
    """How many episodes of the attacks count on these seeds."""
    cells = sum(len(one.cells) for one in attacks if _covers(one, runs, seeds))
    return len(runs) * cells * len(seeds)


@dataclass(frozen=True, eq=False)
class Worst:
    """The robust score of a defended victim.

    Args:
        panel: the attacks that it was chosen from.
        places: [C'] the cells, as indices of the panel's.
        weights: [A, C', E] how much each attack of the panel counts: 1 for the strongest, equal parts of 1 for equals.
        scores: [R, C', E] of the metric, under the strongest attack of each cell and scenario; the mean of equals.
        failed: [R, C', E] whether the episode failed under it; of equals the share.
        some: the attacks that could count, as indices of the panel's.
    """

    panel: Panel
    places: tuple[int, ...]
    weights: Array
    scores: Array
    failed: Array
    some: tuple[int, ...]

    @property
    def runs(self) -> tuple[int, ...]:
        """Training or patch seeds [R]."""
        return self.panel.runs

    @cached_property
    def cells(self) -> tuple[Cell, ...]:
        """[C']."""
        return tuple(self.panel.cells[place] for place in self.places)

    @cached_property
    def attacks(self) -> tuple[Comparison, ...]:
        """The attack of each cell [C'] that counts in most of its scenarios; of equals the first by `_by_weight`."""
        counts = self.weights.sum(2).round(9)
        best = counts == counts.max(0)
        first = {id(one): place for place, one in enumerate(self._by_weight)}
        return tuple(
            min((self.panel.attacks[n] for n in np.flatnonzero(best[:, cell])), key=lambda one: first[id(one)])
            for cell in range(best.shape[1])
        )

    @cached_property
    def _by_weight(self) -> tuple[Comparison, ...]:
        """The attacks of the panel: those that count in most scenarios first, then those with the lowest score."""
        weight = dict(zip(map(id, self.panel.attacks), self.weights.sum((1, 2)).round(6).tolist(), strict=True))
        return tuple(
            sorted(self.panel.attacks, key=lambda one: (-weight[id(one)], round(one.score.estimate, 9), one.content))
        )

    @cached_property
    def order(self) -> tuple[Comparison, ...]:
        """The attacks of the panel: those that are the strongest in most cells first, then those that count in most scenarios."""
        cells = Counter(map(id, self.attacks))
        return tuple(sorted(self._by_weight, key=lambda one: -cells[id(one)]))

    @cached_property
    def name(self) -> str:
        """The attack that is the strongest in most cells."""
        return str(self.most.identity["attack"])

    @property
    def most(self) -> Comparison:
        """The attack that is the strongest in most cells."""
        return self.order[0]

    @property
    def trained(self) -> bool:
        """Whether its runs are trainings, or patches, of which there could be others."""
        return any(one.trained for one in self.panel.attacks)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of cells and of scenarios."""
        return len(self.places), len(self.panel.seeds)

    @cached_property
    def score(self) -> Interval:
        """The headline: over all runs, cells and scenarios. After a race, lower by what that may hide (`Panel.hidden`)."""
        return _lowered(share_interval(self._of_places(self.scores)), self.panel.hidden)

    @cached_property
    def failure(self) -> Interval | None:
        """The share of episodes that fail; None where the track has no failure."""
        return share_interval(self._of_places(self.failed)) if self.most.track.failure else None

    def _of_places(self, values: Array) -> Array:
        return of_places(values, self.panel.seeds, self.most.places)

    @cached_property
    def by_run(self) -> Array:
        """[R, C', E] of the metric, each run under the attack that is the strongest against this run.

        An attack is chosen less well on few runs than on many, so the score of few is too high by what wrong choices leave. By
        run, all numbers of runs have this alike, and can be compared.
        """
        return np.concatenate([under(strongest_of(one), one) for one in np.split(self._scores, len(self.runs), axis=1)])

    @cached_property
    def missed(self) -> Array:
        """[C'] by how much `by_run` is above the score under the attack that looks strongest on the same scenarios.

        The first is too high where the choice was wrong, the second too low by luck: the truth lies between.
        """
        return np.asarray((self.by_run.mean(2) - np.nanmin(self._scores.mean(3), axis=0)).mean(0))

    @property
    def _scores(self) -> Array:
        """[A', R, C', E] of the metric under each attack that could count."""
        return self.panel.scores[np.ix_(self.some, range(len(self.runs)), self.places)]

    @cached_property
    def worst_cell(self) -> tuple[Cell, Interval]:
        """The cell with the lowest score; of equals the first in the order of tables."""
        place = int(self.scores.mean((0, 2)).round(9).argmin())
        return self.cells[place], task_intervals(self._of_places(self.scores)[:, [place]], share=True)[0]

    @cached_property
    def clean(self) -> Interval | None:
        """The same cells and scenarios without an attack; None where a part of them was not driven."""
        found = self._clean
        return None if found is None or np.isnan(found).any() else share_interval(self._of_places(found))

    @property
    def clean_by_cell(self) -> Array:
        """[C'] the mean of each cell without an attack, NaN where it was not driven."""
        return np.full(len(self.places), np.nan) if self._clean is None else self._clean.mean((0, 2))

    @cached_property
    def _clean(self) -> Array | None:
        return self._control(lambda one: one.clean, self._metric)

    @cached_property
    def certified(self) -> float | None:
        """A lower bound of the score under every attack of the threat model; None if there is none.

        Where the victim adds noise, it holds with 97.5 % confidence; where the records have a bound for each episode, it is their
        mean, and holds for sure on these scenarios.
        """
        if "certified" in self.most.own.table.column_names:
            found = self._control(lambda one: one.own, "certified")
            return None if found is None or np.isnan(found).any() else float(found.mean())
        shift = mean(self.most.own.table, "shift")
        return None if self.clean is None or math.isnan(shift) else certificate(self.clean, shift)

    @cached_property
    def rival(self) -> Array:
        """[C', E] of the baseline that the victim is compared with, NaN where it was not driven."""
        contrast = self.most.track.contrast
        if contrast is None or contrast.side != "victim":
            return np.full(self.shape, np.nan)
        return self.beside(self.most.rival, self._metric)

    @cached_property
    def lead(self) -> Interval | None:
        """Minus that baseline, paired scenario by scenario, in the cells where that was driven."""
        known = np.isfinite(self.rival).all(1)
        if not known.any():
            return None
        found = interval((self.scores - self.rival)[:, known])
        return Interval(found.estimate, found.low - self.panel.hidden, found.high)

    def beside(self, baseline: str, column: str) -> Array:
        """[C', E] a measurement of a baseline on the same scenarios, NaN where it was not driven."""
        found = self._control(lambda one: one.baselines.get(baseline), column)
        return np.full(self.shape, np.nan) if found is None else found[0]

    @property
    def _metric(self) -> str:
        return self.panel.attacks[0].track.metric

    def _control(self, of: Callable[[Comparison], Episodes | None], column: str) -> Array | None:
        """[R or 1, C', E] of a control of the attacks, NaN in cells that none has.

        Of a cell that several have, that with the most runs counts, then that of the first attack: they are the same episodes.
        """
        runs, seeds = self.panel.runs, self.panel.seeds
        found = None
        for control in sorted(filter(None, map(of, self.panel.attacks)), key=lambda one: -len(one.runs)):
            if not set(seeds) <= set(control.seeds):
                continue
            alone = len(control.runs) == 1 and control.runs != runs
            if not (alone or set(runs) <= set(control.runs)):
                continue
            of_runs = control.runs if alone else runs
            if found is None:
                found = np.full((len(of_runs), *self.shape), np.nan)
            missing = [n for n, cell in enumerate(self.cells) if np.isnan(found[:, n]).any() and cell in control.cells]
            if len(of_runs) == len(found) and missing:
                places = control.places(of_runs, [self.cells[n] for n in missing], seeds)
                found[:, missing] = control.column(column)[places]
        return found


def _lowered(score: Interval, by: float) -> Interval:
    return Interval(score.estimate, max(score.low - by, 0.0), score.high)


def margin(first: Worst, second: Worst) -> Interval | None:
    """`first` minus `second`, in the cells and scenarios that both have; None where they have none.

    What a race may hide of either (`Panel.hidden`) makes it wider.
    """
    found = _margin(first, second)
    if found is None or first.panel is second.panel:
        return found
    return Interval(found.estimate, found.low - first.panel.hidden, found.high + second.panel.hidden)


def _margin(first: Worst, second: Worst) -> Interval | None:
    """`margin`, as if nothing had been dropped.

    Of the same defended victim, and of two with the same training seeds, runs are paired. All others were trained apart
    (`independent`); if their numbers of trainings differ, the attacks are chosen for each training alone.
    """
    cells = [cell for cell in first.cells if cell in second.cells]
    seeds = [seed for seed in first.panel.seeds if seed in second.panel.seeds]
    if not (cells and seeds):
        return None
    both = (first, second)
    places = [
        np.ix_([one.cells.index(cell) for cell in cells], [one.panel.seeds.index(seed) for seed in seeds])
        for one in both
    ]
    common = sorted(set(first.runs) & set(second.runs))
    same = first.most.defended == second.most.defended
    rules = [len(one.runs) == 1 and not one.trained for one in both]
    if common and (same or all(rules) or (first.runs == second.runs and len(common) > 1)):
        runs = [[one.runs.index(run) for run in common] for one in both]
        paired = [one.scores[of][:, place[0], place[1]] for one, of, place in zip(both, runs, places, strict=True)]
        return interval(paired[0] - paired[1])
    alike = len(first.runs) == len(second.runs)
    sides = [
        (one.scores if alike else one.by_run)[:, place[0], place[1]] for one, place in zip(both, places, strict=True)
    ]
    # Without weights, runs differ by the network of an attack, of which the one run of the other side has one, too.
    learns = [one.trained or not other.trained for one, other in (both, both[::-1])]
    missed = [
        0.0 if alike else float(one.missed[place[0].ravel()].mean()) for one, place in zip(both, places, strict=True)
    ]
    return independent(sides[0], sides[1], trained=(learns[0], learns[1]), chosen=(missed[0], missed[1]))
