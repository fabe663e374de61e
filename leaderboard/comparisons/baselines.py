"""The baselines of a comparison on its own scenarios: victims that ignore their input, attacks that know nothing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import pyarrow as pa

from cavbench.core.track import Track
from cavbench.leaderboard.comparisons.comparison import IDENTITY
from cavbench.scenarios import Cell
from cavbench.statistics.episodes import Episodes


class Baselines:
    """All that may be a baseline in some records, found again for the same scenarios at once.

    Args:
        track: says what is a baseline for what.
        candidates: clean controls and attacks; those that are no baseline are left out.
    """

    def __init__(self, track: Track, candidates: Sequence[Episodes]) -> None:
        self.track = track
        both = [(identity_of(one), one) for one in candidates]
        # Of equally good candidates the first counts, so their order is that of what they are.
        both.sort(key=lambda one: [str(value) for value in one[0].values()])
        self.candidates = [(identity, one) for identity, one in both if track.baseline_of(identity, identity)]
        self._known: dict[tuple[object, ...], dict[str, Episodes]] = {}

    def beside(self, own: Episodes) -> Mapping[str, Episodes]:
        """The baselines of some episodes, by name, each in the cells that it has of theirs.

        Where one name stands for several, such as all policies that ignore their input, the best counts in each cell. It is
        chosen on the scenarios that it is reported on: that favours it.
        """
        identity = identity_of(own)
        named = [self.track.baseline_of(other, identity) for other, _ in self.candidates]
        key = (tuple(named), own.runs, own.cells, own.seeds)
        if key not in self._known:
            self._known[key] = dict(self._found(named, own))
        return self._known[key]

    def _found(self, named: Sequence[str], own: Episodes) -> Iterator[tuple[str, Episodes]]:
        order = list(self.track.baseline_kinds)
        for name in sorted(
            filter(None, set(named)), key=lambda one: (order.index(one) if one in order else len(order), one)
        ):
            same = [one for found, (_, one) in zip(named, self.candidates, strict=True) if found == name]
            there = list(filter(None, (_on_scenarios_of(own, one) for one in same)))
            if there:
                yield name, there[0] if len(there) == 1 else self._best(there)

    def _best(self, candidates: Sequence[Episodes]) -> Episodes:
        """Of each cell the best candidate: the highest score of a victim, the lowest one under an attack."""
        contrast = self.track.contrast
        sign = -1 if contrast and contrast.side == "attack" else 1
        chosen: dict[Cell, tuple[float, pa.Table]] = {}
        for candidate in candidates:
            for cell in candidate.cells if candidate.runs == candidates[0].runs else ():
                part = candidate.only(cells=[cell])
                score = sign * float(part.column(self.track.metric).mean())
                if cell not in chosen or score > chosen[cell][0]:
                    chosen[cell] = (score, part.table)
        return Episodes.arrange(pa.concat_tables([rows for _, rows in chosen.values()]))


def identity_of(episodes: Episodes) -> dict[str, Any]:
    """The columns that all episodes of a comparison share."""
    return dict(episodes.table.select(list(IDENTITY)).slice(0, 1).to_pylist()[0])


def _on_scenarios_of(own: Episodes, candidate: Episodes) -> Episodes | None:
    """A candidate on the scenarios of `own`: on the same training seeds, or with the one run that it has."""
    blind = not candidate.table["sees"][0].as_py()
    driven = set(candidate.cells)
    cells = [cell for cell in own.cells if cell in driven or (blind and candidate.axes.unperceived(cell) in driven)]
    if not cells or not set(own.seeds) <= set(candidate.seeds):
        return None
    if blind:
        return candidate.standing_for(own.runs[:1], cells).only(seeds=own.seeds)
    if set(own.runs) <= set(candidate.runs):
        return candidate.only(runs=own.runs, cells=cells, seeds=own.seeds)
    return candidate.only(cells=cells, seeds=own.seeds) if len(candidate.runs) == 1 else None
