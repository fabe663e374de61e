"""The look of every table: columns of headings and how to fill them; what a terminal has no room for is left out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby, product
from typing import Generic, Literal, TypeVar

from rich import box
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from bench.scenarios import Cell

Subject = TypeVar("Subject")
STRIP = 25
"""Characters of a strip chart."""


@dataclass(frozen=True)
class Column(Generic[Subject]):
    """A column of a table.

    Args:
        heading: at most two lines.
        value: what it shows of a row's subject.
        justify: numbers to the right, text to the left.
        spare: columns are left out of a narrow terminal from the highest number down; 0 stays.
        folds: names that may be long; they go on in the next line where there is no room otherwise.
    """

    heading: str
    value: Callable[[Subject], Text | str]
    justify: Literal["left", "right"] = "right"
    spare: int = 0
    folds: bool = False


@dataclass(frozen=True)
class Section(Generic[Subject]):
    """Rows that belong together, under a title of their own where there is one."""

    subjects: Sequence[Subject]
    title: Text | None = None


def fitted(columns: Sequence[Column[Subject]], sections: Sequence[Section[Subject]], console: Console) -> Table:
    """The table with as many of the columns as the console has room for, and air between them where there is room."""
    room = console.width - 2
    limits = range(max(column.spare for column in columns), -1, -1)
    for names, limit, gap in product((None, console.width // 3), limits, (1, 0)):
        made = _table([column for column in columns if column.spare <= limit], sections, gap, names)
        if Measurement.get(console, console.options.update(max_width=10_000), made).maximum <= room:
            break
    return made


def _table(
    columns: Sequence[Column[Subject]], sections: Sequence[Section[Subject]], gap: int, names: int | None
) -> Table:
    """With `gap` characters between the columns; names that fold are at most `names` wide."""
    made = Table(box=box.SIMPLE_HEAD, header_style="dim", padding=(0, gap, 0, 0), pad_edge=False, show_edge=False)
    for column in columns:
        whole = not column.folds or names is None
        made.add_column(
            column.heading,
            justify=column.justify,
            no_wrap=whole,
            max_width=None if whole else names,
            vertical="bottom",
        )
    for section in sections:
        if section.title is not None:
            made.add_row(section.title)
        for subject in section.subjects:
            made.add_row(*(_text(column.value(subject)) for column in columns))
        made.add_section()
    return made


def axis(measure: str = "safe progress") -> str:
    """The heading of a strip chart: 0 at its left end, 1 at its right."""
    return f"{measure}\n0" + "0.5".center(STRIP - 2) + "1"


def _text(value: Text | str) -> Text:
    """As it stands: a parameter like `speeds=[20]` is no markup."""
    return value if isinstance(value, Text) else Text(value)


def rows_by_weather(cells: Iterable[Cell]) -> list[list[tuple[Text, list[Cell]]]]:
    """The rows of each weather: one of its own where it has several cells, then a row a cell; with the cells each is of."""
    found = []
    for weather, group in groupby(cells, key=lambda cell: cell.weather):
        own = list(group)
        whole = [(Text(weather, style="bold"), own)] if len(own) > 1 else []
        indent = "  " if whole else f"{weather} "
        found.append([*whole, *((Text(f"{indent}{cell.lanes} × {cell.density:g}"), [cell]) for cell in own)])
    return found
