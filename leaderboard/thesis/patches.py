"""Chapter 3 of the thesis, patches on a stop sign: tables 3.1, 3.2 and 3.3 beside ours."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pyarrow as pa
from rich.console import Console
from rich.text import Text

from cavbench.core import registry
from cavbench.leaderboard.comparisons.comparison import NO_ATTACK
from cavbench.leaderboard.terminal.layout import Column, Section, fitted
from cavbench.leaderboard.terminal.text import (
    ATTACKED,
    BASELINE,
    CLEAN,
    MISSING,
    bounds,
    change,
    estimate,
    share,
    signed,
)
from cavbench.leaderboard.thesis.claims import configuration_claims, location_claims
from cavbench.leaderboard.thesis.numbers import PUBLISHED, THESIS, Beside, as_printed
from cavbench.leaderboard.thesis.patch_records import (
    CONFIGURATIONS,
    CONTROLS,
    LOCATIONS,
    STANDARD,
    WEATHERS,
    Found,
    Source,
)

GRID = "approach-v1"
"""Whose roads are the standard ones."""
CONTROL_LABELS = {"noise_patch": "random noise", "grey_patch": "grey", NO_ATTACK: "no patch"}


@dataclass(frozen=True)
class Line:
    """A row of a table: what the thesis says, by column, and what stands beside it, by detector."""

    row: str
    found: Sequence[Found | None]
    thesis: Mapping[str, Text | str] = field(default_factory=dict)


def heading() -> Text:
    """On what settings the numbers of chapter 3 were made, the thesis' and ours."""
    return Text.assemble(
        "A detector's confidence in a stop sign, 0 in a frame that misses it: thesis ",
        ("as printed", THESIS),
        " (YOLOv5, size not stated; 10 frames), ours on approaches of 10 frames at places that no patch was crafted at, ",
        "mean over patch seeds and roads (3 to 5 lanes, density 1 and 2) with its 95 % interval.\n",
        f"Ours: attack eot, a patch {CONFIGURATIONS[STANDARD].budget:g} as wide as the sign where nothing else is said; ",
        "sun is clear weather. lost: share of the confidence without a patch. beyond control: confidence minus that under ",
        "random noise or grey of the same size, whichever is lower, paired (thesis: random noise); below 0 the patch knows ",
        "something of the detector.",
    )


def tables(numbers: Mapping[str, Any], records: pa.Table, console: Console) -> Iterator[Beside]:
    """Each table of chapter 3 beside ours.

    Args:
        numbers: the thesis', by table.
        records: the user's; where they have none, those published with the package are read.
        console: what it has no room for is left out.
    """
    source = Source(records)
    made = {"static": static_table, "configurations": configuration_table, "locations": location_table}
    shown = {name: table(numbers[name], source) for name, table in made.items()}
    for name, (columns, sections, notes) in shown.items():
        # One command makes what several tables lack.
        commands = source.commands() if name == "locations" else []
        yield Beside(numbers[name], fitted([*columns, *_ours(source)], sections, console), notes, commands)


Made = tuple[list[Column[Line]], list[Section[Line]], list[Text]]


def static_table(section: Mapping[str, Any], source: Source) -> Made:
    """Table 3.1; a loss on one image has no counterpart, the confidence under the same patches on new approaches has."""
    columns = [
        _label(),
        _column("thesis\nmax score", "max_score"),
        _column("TV\nloss", "tv_loss", spare=4),
        _column("total\nloss", "total_loss", spare=4),
        _column("top\nconf.", "confidence", spare=2),
        Column("\nlabel", lambda line: line.thesis.get("label", ""), "left", spare=5),
    ]
    lines = []
    for row, found in _found(source, (*CONFIGURATIONS, *CONTROLS), "clear").items():
        printed = section["rows"].get(row, {})
        losses = {name: as_printed(printed.get(name), 4) for name in ("max_score", "tv_loss", "total_loss")}
        surest = {
            "confidence": as_printed(printed.get("confidence"), 3),
            "label": Text(printed.get("label", ""), THESIS),
        }
        lines.append(Line(row, found, losses | surest))
    note = Text(
        "Ours is no loss: the thesis' score is on the image that the patch was crafted on, which a patch without transformations "
        "fits best and which says nothing of other views. Beside it stands the confidence under the same configuration on "
        "new approaches, clear weather, all three locations."
    )
    sections = _with_controls(lines)
    return columns, sections, [note, *_roads(source, sections), *configuration_claims(source, {"": ("clear", None)})]


def configuration_table(section: Mapping[str, Any], source: Source) -> Made:
    """Table 3.2: the configurations in sun and rain."""
    sections = []
    for theirs, ours in WEATHERS.items():
        printed = {row: values[theirs] for row, values in section["rows"].items()}
        lines = []
        for row, found in _found(source, (*CONFIGURATIONS, *CONTROLS), ours, LOCATIONS[1]).items():
            median = as_printed(section["rows"].get(row, {}).get(f"{theirs}_median"), 3)
            lines.append(Line(row, found, _derived(printed, row) | {"median": median}))
        sections += _with_controls(lines, theirs)
    columns = [_label(), *_confidences(), _column("median", "median", spare=4)]
    places = {theirs: (ours, LOCATIONS[1]) for theirs, ours in WEATHERS.items()}
    return columns, sections, [*_roads(source, sections), *configuration_claims(source, places)]


def location_table(section: Mapping[str, Any], source: Source) -> Made:
    """Table 3.3: the patch and its controls where the sun stands elsewhere."""
    sections = []
    for printed in section["rows"]:
        for theirs, ours in WEATHERS.items():
            confidences = {row: printed[row][theirs] for row in (STANDARD, "noise_patch", NO_ATTACK)}
            rows = _found(source, (STANDARD, *CONTROLS), ours, LOCATIONS[printed["location"]])
            lines = [Line(row, found, _derived(confidences, row)) for row, found in rows.items()]
            sections.append(Section(lines, Text(f"location {printed['location']}, {theirs}", style="bold")))
    places = [f"{row['location']}, the sun {row['light']}: {LOCATIONS[row['location']]}" for row in section["rows"]]
    note = Text(f"The thesis' locations and ours: {'; '.join(places)}.")
    return [_label(), *_confidences()], sections, [note, *_roads(source, sections), *location_claims(source)]


def _found(
    source: Source, rows: Sequence[str], weather: str, location: str | None = None
) -> dict[str, list[Found | None]]:
    """What stands in each row, by detector."""
    by_detector = [source.find_all(detector, rows, weather, location) for detector in source.detectors]
    return {row: [found[row] for found in by_detector] for row in rows}


def _roads(source: Source, sections: Sequence[Section[Line]]) -> Iterator[Text]:
    """On which roads the numbers of a detector are, where those are not the standard ones."""
    standard = frozenset((cell.lanes, cell.density) for cell in registry.grid(GRID).cells())
    for place, detector in enumerate(source.detectors):
        found = [line.found[place] for section in sections for line in section.subjects]
        roads = {frozenset((cell.lanes, cell.density) for cell in each.of.cells) for each in found if each}
        if roads - {standard}:
            which = [", ".join(f"{lanes} × {density:g}" for lanes, density in sorted(some)) for some in roads]
            yield Text(
                f"{detector.victim}: on the roads {'; or '.join(sorted(which))} only (lanes × density).", style="yellow"
            )


def _derived(printed: Mapping[str, float], row: str) -> dict[str, Text | str]:
    """A confidence of the thesis, the share of the unpatched one that is lost, and what is left beyond random noise."""
    value = printed.get(row)
    if value is None or row == NO_ATTACK:
        return {"confidence": as_printed(value, 3)}
    found: dict[str, Text | str] = {
        "confidence": as_printed(value, 3),
        "lost": Text(share(1 - value / printed[NO_ATTACK]), style=THESIS),
    }
    if row not in CONTROLS:
        found["beyond"] = Text(signed(value - printed["noise_patch"], 2), style=THESIS)
    return found


def _with_controls(lines: Sequence[Line], title: str = "") -> list[Section[Line]]:
    crafted = [line for line in lines if line.row in CONFIGURATIONS]
    return [
        Section(crafted, Text(title, style="bold") if title else None),
        Section([line for line in lines if line.row in CONTROLS]),
    ]


def _label() -> Column[Line]:
    def value(line: Line) -> Text:
        if line.row in CONFIGURATIONS:
            return Text(CONFIGURATIONS[line.row].label, style=ATTACKED)
        return Text(CONTROL_LABELS[line.row], style=CLEAN if line.row == NO_ATTACK else BASELINE)

    return Column("", value, "left")


def _column(heading: str, name: str, spare: int = 0) -> Column[Line]:
    return Column(heading, lambda line: line.thesis.get(name, ""), spare=spare)


def _confidences() -> list[Column[Line]]:
    return [
        _column("thesis\nmean", "confidence"),
        _column("\nlost", "lost", spare=1),
        _column("beyond\nnoise", "beyond", spare=1),
    ]


def _ours(source: Source) -> list[Column[Line]]:
    columns: list[Column[Line]] = []
    for place, detector in enumerate(source.detectors):
        columns += [
            Column(f"{detector.victim}\nours [95 %]", _of(place, _confidence), "left"),
            Column("\nlost", _of(place, _lost), spare=1),
            Column("beyond\ncontrol", _of(place, _beyond)),
            Column(
                "\n[95 %]", _of(place, lambda found: bounds(found.of.lead) if found.of.lead else Text("")), "left", 3
            ),
        ]
    return columns


def _of(place: int, written: Callable[[Found], Text]) -> Callable[[Line], Text]:
    """What stands in a column of the detector at this place."""

    def value(line: Line) -> Text:
        found = line.found[place]
        return written(found) if found else Text(MISSING, style="dim")

    return value


def _confidence(found: Found) -> Text:
    written = estimate(found.of.score)
    return written.append(PUBLISHED, style="dim") if found.shipped else written


def _lost(found: Found) -> Text:
    return Text(share(1 - found.of.retained) if found.of.is_attacked else "")


def _beyond(found: Found) -> Text:
    return change(found.of.lead) if found.of.is_attacked and not found.of.is_baseline else Text("")
