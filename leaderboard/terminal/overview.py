"""The overview of a run: a section a defended victim, a row an attack, and the baselines below."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

from rich.console import Console
from rich.table import Table
from rich.text import Text

from bench.plugins.track import Measure
from bench.statistics.episodes import Episodes, measured
from leaderboard.comparisons.comparison import THREAT, Comparison
from leaderboard.comparisons.naming import component, defended, varying
from leaderboard.terminal.columns import measure_columns, written
from leaderboard.terminal.layout import STRIP, Column, Section, axis, fitted
from leaderboard.terminal.text import (
    ATTACKED,
    BASELINE,
    CLEAN,
    bounds,
    change,
    estimate,
    share,
    strip,
    verdict,
)


@dataclass(frozen=True)
class Line:
    """A row: a name, some episodes, and the comparison that they are of.

    Args:
        name: of the row.
        colour: of its score.
        episodes: that are measured.
        of: the comparison that they stand in; they may be its control or its baseline.
    """

    name: str
    colour: str
    episodes: Episodes
    of: Comparison

    @property
    def attack(self) -> Comparison | None:
        """The comparison, where these are its episodes under attack."""
        return self.of if self.episodes is self.of.attacked else None


def overview(comparisons: Sequence[Comparison], console: Console) -> Table:
    """All comparisons of a track in one table, the strongest attack on a defended victim first."""
    return fitted(_columns(comparisons), list(_sections(comparisons)), console)


def _columns(comparisons: Sequence[Comparison]) -> list[Column[Line]]:
    track = comparisons[0].track
    columns: list[Column[Line]] = [
        Column("", lambda line: f"  {line.name}", "left", folds=True),
        Column(f"{track.metric_title}\n[95 %]", _score, "left"),
    ]
    if any(one.is_attacked for one in comparisons):
        columns.append(Column("kept", lambda line: share(line.attack.retained) if line.attack else ""))
        if any(one.baselines for one in comparisons) and track.contrast:
            spare = 0 if track.contrast.side == "victim" else 2
            columns += [
                Column(track.contrast.heading, _lead, "left", spare=spare),
                Column(
                    "\n[95 %]",
                    lambda line: bounds(line.attack.lead) if line.attack and line.attack.lead else "",
                    "left",
                    7,
                ),
            ]
    columns += measure_columns(comparisons, "overview", _measure)
    strips = Column[Line](axis(track.metric_title), _strip, "left", spare=9)
    return [*columns, strips]


def _measure(measure: Measure) -> Callable[[Line], Text | str]:
    def value(line: Line) -> Text | str:
        if measure.of_attack and not line.attack:
            return ""
        return written(measure, measured(line.episodes, measure), with_interval=measure.with_interval)

    return value


def _score(line: Line) -> Text:
    return estimate(line.of.score_of(line.episodes), style=line.colour)


def _strip(line: Line) -> Text:
    return strip({line.colour: line.of.score_of(line.episodes)}, STRIP)


def _lead(line: Line) -> Text:
    if line.attack is None or line.attack.lead is None:
        return Text("")
    contrast = line.of.track.contrast
    if contrast and contrast.side == "victim":
        return Text.assemble(verdict(line.attack.lead), " ", change(line.attack.lead))
    return change(line.attack.lead)


def _sections(comparisons: Sequence[Comparison]) -> Iterator[Section[Line]]:
    shown = {kind: varying(comparisons, kind) for kind in ("attack", "defense", "victim", "world")}
    for _, group in groupby(comparisons, key=lambda one: one.defended):
        members = list(group)
        first = members[0]
        title = Text(defended(first, shown), style="bold")
        if shown["world"]:
            title.append(f" in {component(first, 'world', shown['world'])}", style="dim")
        control = next((one for one in members if one.clean), None)
        lines = [Line("no attack", CLEAN, control.clean, control)] if control and control.clean else []
        for one in members:
            if one.is_attacked:
                name = component(one, "attack", shown["attack"]) + _threat_words(one, comparisons)
                lines.append(Line(name, BASELINE if one.is_baseline else ATTACKED, one.own, one))
        yield Section(lines, title)
    yield from _baseline_sections(comparisons)


def _threat_words(one: Comparison, comparisons: Sequence[Comparison]) -> str:
    """What tells the threat models of a sweep apart."""
    identities = [other.identity for other in comparisons if other.is_attacked]
    names = [name for name in (*THREAT, "grid") if len({str(each[name]) for each in identities}) > 1]
    return "".join(f" {one.identity[name]}" for name in names)


def _baseline_sections(comparisons: Sequence[Comparison]) -> Iterator[Section[Line]]:
    """The victims that ignore their input, once a world and type of action: they have no training seeds, so one run counts."""

    def kind(one: Comparison) -> tuple[str, ...]:
        return tuple(str(one.identity[name]) for name in ("action_type", "world", "world_params"))

    kinds = {kind(one): one for one in reversed(comparisons) if one.baselines}
    for (actions, *_), one in kinds.items():
        title = Text("baselines", style="bold")
        if actions and len(kinds) > 1:
            title.append(f" of {actions} actions")
        titles = {name: known.title for name, known in one.track.baseline_kinds.items()}
        lines = [
            Line(titles.get(name, name), BASELINE, episodes.only(runs=episodes.runs[:1]), one)
            for name, episodes in one.baselines.items()
            if not _attacked(episodes)
        ]
        if lines:
            yield Section(lines, title)


def _attacked(episodes: Episodes) -> bool:
    """Whether these are under a baseline attack, which has a row among the attacks."""
    return bool(episodes.table["attack"][0].as_py() != "none")
