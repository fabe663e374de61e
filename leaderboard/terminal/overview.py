"""The overview of a run: a section a defended victim, a row an attack, and the baselines below."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby

from rich.console import Console
from rich.table import Table
from rich.text import Text

from cavbench.core import sets
from cavbench.core.track import Measure, Track
from cavbench.leaderboard.comparisons.comparison import THREAT, Comparison
from cavbench.leaderboard.comparisons.naming import component, defended, varying
from cavbench.leaderboard.ranking.worst import Panel, Worst
from cavbench.leaderboard.terminal.columns import measure_columns, written
from cavbench.leaderboard.terminal.layout import STRIP, Column, Section, axis, cell_name, fitted
from cavbench.leaderboard.terminal.text import (
    ATTACKED,
    BASELINE,
    CLEAN,
    bounds,
    change,
    counted,
    estimate,
    number,
    share,
    strip,
    verdict,
)
from cavbench.scenarios import Cell
from cavbench.statistics.episodes import Episodes, measured
from cavbench.statistics.estimates import Interval


@dataclass(frozen=True)
class Line:
    """A row of the overview.

    Args:
        name: of the row.
        colour: of its score.
        score: the metric; of several attacks in one row a text.
        measure: a measure of the track, as the row shows it; empty where it does not apply.
        worst_cell: the cell with the lowest score, and that score; None where there is one cell only.
        kept: retention; None where nothing was attacked.
        lead: the score minus the baseline's; None where there is none.
    """

    name: Text
    colour: str
    score: Interval | Text | None
    measure: Callable[[Measure], Text | str]
    worst_cell: tuple[Cell, float] | None = None
    kept: float | None = None
    lead: Interval | None = None


def overview(comparisons: Sequence[Comparison], console: Console, lines: int | None = None) -> Table:
    """All comparisons of a track in one table, the strongest attack on a defended victim first.

    Args:
        comparisons: of the track.
        console: where the table is printed; a narrow one has fewer columns.
        lines: largest number of lines below the heading. Weak attacks share a line where there would be more, but every
            defended victim keeps its strongest attack. None for no limit.
    """
    return fitted(_columns(comparisons), _shortened(comparisons, lines), console, apart=lines is None)


def _shortened(comparisons: Sequence[Comparison], lines: int | None) -> list[Section[Line]]:
    """The sections with as many attacks on each defended victim as there is room for."""
    most = max((len(group) for group in _by_defended(comparisons)), default=0)
    for attacks in range(most, 0, -1):
        sections = list(_sections(comparisons, attacks))
        if lines is None or sum(len(section.subjects) for section in sections) <= lines:
            break
    return sections


def _columns(comparisons: Sequence[Comparison]) -> list[Column[Line]]:
    track = comparisons[0].track
    columns: list[Column[Line]] = [
        Column("", lambda line: line.name, "left", folds=True),
        Column(f"{track.metric_title}\n[95 %]", _score, "left"),
    ]
    if any(one.is_attacked for one in comparisons):
        columns.append(Column("kept", lambda line: "" if line.kept is None else share(line.kept)))
        if any(one.baselines for one in comparisons) and track.contrast:
            spare = 0 if track.contrast.side == "victim" else 2
            columns += [
                Column(track.contrast.heading, partial(_lead, track), "left", spare=spare),
                Column("\n[95 %]", lambda line: bounds(line.lead) if line.lead else "", "left", 7),
            ]
    measures: list[Column[Line]] = measure_columns(comparisons, "overview", _measured)
    if any(len(one.cells) > 1 for one in comparisons):
        columns += [*measures[:1], Column("worst cell\n", _worst_cell, "left"), *measures[1:]]
    else:
        columns += measures
    return [*columns, Column(axis(track.metric_title), _strip, "left", spare=9)]


def _measured(measure: Measure) -> Callable[[Line], Text | str]:
    return lambda line: line.measure(measure)


def _worst_cell(line: Line) -> Text | str:
    if line.worst_cell is None:
        return ""
    cell, score = line.worst_cell
    return Text.assemble(number(score, 2), (f" {cell_name(cell)}", "dim"))


def _score(line: Line) -> Text:
    return line.score if isinstance(line.score, Text) else estimate(line.score, style=line.colour)


def _strip(line: Line) -> Text | str:
    return "" if isinstance(line.score, Text) else strip({line.colour: line.score}, STRIP)


def _lead(track: Track, line: Line) -> Text:
    if line.lead is None:
        return Text("")
    if track.contrast and track.contrast.side == "victim":
        return Text.assemble(verdict(line.lead), " ", change(line.lead))
    return change(line.lead)


def _line(name: Text, colour: str, episodes: Episodes, of: Comparison) -> Line:
    """The row of some episodes of a comparison: under its attack, without one, or of its baseline."""
    attack = of if episodes is of.attacked else None

    def value(measure: Measure) -> Text | str:
        if measure.of_attack and not attack:
            return ""
        return written(measure, measured(episodes, measure), with_interval=measure.with_interval)

    return Line(
        name,
        colour,
        of.score_of(episodes),
        value,
        _lowest(episodes, of),
        attack.retained if attack else None,
        attack.lead if attack else None,
    )


def _lowest(episodes: Episodes, of: Comparison) -> tuple[Cell, float] | None:
    means = episodes.column(of.track.metric).mean((0, 2))
    return (episodes.cells[int(means.argmin())], float(means.min())) if len(means) > 1 else None


def _strongest(worst: Worst) -> Line:
    """The row of the strongest attack of each cell, by which leaderboards rank."""
    track = worst.most.track

    def value(measure: Measure) -> Text | str:
        known = measure.column == track.failure and worst.failure
        return written(measure, worst.failure, with_interval=measure.with_interval) if known and worst.failure else ""

    cell, lowest = worst.worst_cell
    clean = worst.clean.estimate if worst.clean else 0.0
    kept = worst.score.estimate / clean if clean > 0 else float("nan")
    name = Text("  strongest per cell")
    return Line(name, ATTACKED, worst.score, value, (cell, lowest.estimate), kept, worst.lead)


def _by_defended(comparisons: Sequence[Comparison]) -> list[list[Comparison]]:
    return [list(group) for _, group in groupby(comparisons, key=lambda one: one.defended)]


def _sections(comparisons: Sequence[Comparison], attacks: int) -> Iterator[Section[Line]]:
    """A section a defended victim, with at most so many of its attacks; then the baselines."""
    shown = {kind: varying(comparisons, kind) for kind in ("attack", "defense", "victim", "world")}
    for members in _by_defended(comparisons):
        first = members[0]
        title = Text(defended(first, shown), style="bold")
        if shown["world"]:
            title.append(f" in {component(first, 'world', shown['world'])}", style="dim")
        control = next((one for one in members if one.clean), None)
        if control and control.clean:
            name = Text.assemble(title, (", clean", "dim"))
            lines = [_line(name, CLEAN, control.clean, control)]
        else:
            lines = [Line(title, CLEAN, None, lambda measure: "")]
        attacked = [one for one in members if one.is_attacked]
        own = [one for one in attacked if not one.is_baseline]
        if len(own) > 1 and _one_threat(own) and (worst := Panel.of(own).strongest()) and len(worst.cells) > 1:
            lines.append(_strongest(worst))
        for one in attacked[:attacks]:
            name = Text(f"  {component(one, 'attack', shown['attack'])}{_threat_words(one, comparisons)}")
            lines.append(_line(name, BASELINE if one.is_baseline else ATTACKED, one.own, one))
        if weaker := attacked[attacks:]:
            scores = [one.score.estimate for one in weaker]
            lines.append(_weaker(len(weaker), min(scores), max(scores)))
        yield Section(lines)
    yield from _baseline_sections(comparisons)


def _weaker(count: int, low: float, high: float) -> Line:
    between = f"{number(low, 2)} to {number(high, 2)}" if low < high else number(low, 2)
    name = Text(f"  {counted(count, 'weaker attack')}", style="dim")
    return Line(name, ATTACKED, Text(between, style="dim"), lambda measure: "")


def _one_threat(attacks: Sequence[Comparison]) -> bool:
    return len({str([one.identity[name] for name in (*THREAT, "grid")]) for one in attacks}) == 1


def _threat_words(one: Comparison, comparisons: Sequence[Comparison]) -> str:
    """What tells the threat models of a sweep apart; of their sets only the fields that not all of them have, by short names."""
    identities = [other.identity for other in comparisons if other.is_attacked]
    common = common_sets(comparisons)
    words = [_short(word) for word in _sets(one) if word not in common]
    names = [name for name in (*THREAT[1:], "grid") if len({str(each[name]) for each in identities}) > 1]
    return "".join(f" {word}" for word in (*words, *(one.identity[name] for name in names)))


def _short(word: str) -> str:
    """`hidden=1` of `presence.hidden=1`, so that a narrow table has room for it."""
    key, sign, value = word.partition("=")
    return f"{key.rpartition('.')[2]}{sign}{value}"


def common_sets(comparisons: Sequence[Comparison]) -> list[str]:
    """The sets that the threat models of all attacks have, each as `threat.` takes it; the perturbation set, too, is one."""
    attacked = [_sets(one) for one in comparisons if one.is_attacked]
    return [word for word in attacked[0] if all(word in other for other in attacked)] if attacked else []


def _sets(one: Comparison) -> list[str]:
    norm, others = sets.split(str(one.identity["threat_norm"]))
    return [norm, *others]


def _baseline_sections(comparisons: Sequence[Comparison]) -> Iterator[Section[Line]]:
    """The victims that ignore their input, once a world and type of action: they have no training seeds, so one run counts."""

    def kind(one: Comparison) -> tuple[str, ...]:
        return tuple(str(one.identity[name]) for name in ("action_type", "world", "world_params"))

    kinds = {kind(one): one for one in reversed(comparisons) if one.baselines}
    for (actions, *_), one in kinds.items():
        suffix = f", {actions} actions" if actions and len(kinds) > 1 else ""
        titles = {name: known.title for name, known in one.track.baseline_kinds.items()}
        lines = [
            _line(Text(f"{titles.get(name, name)}{suffix}"), BASELINE, episodes.only(runs=episodes.runs[:1]), one)
            for name, episodes in one.baselines.items()
            if not _attacked(episodes)
        ]
        if lines:
            yield Section(lines)


def _attacked(episodes: Episodes) -> bool:
    """Whether these are under a baseline attack, which has a row among the attacks."""
    return bool(episodes.table["attack"][0].as_py() != "none")
