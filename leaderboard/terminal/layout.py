"""The layout of every table: columns with headings; columns that a terminal has no room for are left out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, product
from typing import Generic, Literal, TypeVar

from rich import box
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from cavbench.scenarios import Axes, Cell
from cavbench.scenarios.axes import written

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


def fitted(
    columns: Sequence[Column[Subject]], sections: Sequence[Section[Subject]], console: Console, *, apart: bool = True
) -> Table:
    """The table with as many of the columns as the console has room for, and a space between them where there is room.

    Args:
        columns: from left to right.
        sections: from top to bottom.
        console: where the table is printed.
        apart: whether there is an empty line between the sections; otherwise there is room for few lines.
    """
    room = console.width - 2
    rows = [
        [[_text(column.value(subject)) for column in columns] for subject in section.subjects] for section in sections
    ]
    titles = [section.title for section in sections]
    limits = range(max(column.spare for column in columns), -1, -1)
    # Fewer columns rather than a name in two lines; then two lines rather than no space between columns, unless lines are few. No
    # word is broken, unless a terminal has no room for it.
    close, folded_names = list(product((False, True), (0,), (0,))), list(product((True,), limits, (1,)))
    tries = [*product((False,), limits, (1,)), *(folded_names + close if apart else close + folded_names)]
    for folded, limit, gap in tries:
        kept = [place for place, column in enumerate(columns) if column.spare <= limit]
        texts = [[[row[place] for place in kept] for row in section] for section in rows]
        own = [columns[place] for place in kept]
        widths = _least(own, texts) if folded else {}
        made = _table(own, list(zip(titles, texts, strict=True)), gap, widths, apart)
        left = room - Measurement.get(console, console.options.update(max_width=10_000), made).maximum
        if left >= 0:
            break
    # Folded names get the room that is left.
    for place, least in widths.items():
        widths[place] = min(_longest(texts, place), least + max(left, 0))
        left -= widths[place] - least
    return _table(own, list(zip(titles, texts, strict=True)), gap, widths, apart) if widths else made


def _least(columns: Sequence[Column[Subject]], texts: Sequence[Sequence[Sequence[Text]]]) -> dict[int, int]:
    """How wide each column of names is at least: as its longest word."""
    return {
        place: max((len(word) for section in texts for row in section for word in row[place].plain.split()), default=1)
        for place, column in enumerate(columns)
        if column.folds
    }


def _longest(texts: Sequence[Sequence[Sequence[Text]]], place: int) -> int:
    return max((len(row[place].plain) for section in texts for row in section), default=1)


def _table(
    columns: Sequence[Column[Subject]],
    sections: Sequence[tuple[Text | None, Sequence[Sequence[Text]]]],
    gap: int,
    widths: Mapping[int, int],
    apart: bool,
) -> Table:
    """With `gap` characters between the columns; the names in some have a width, and go on in the next line."""
    made = Table(box=box.SIMPLE_HEAD, header_style="dim", padding=(0, gap, 0, 0), pad_edge=False, show_edge=False)
    for place, column in enumerate(columns):
        made.add_column(
            column.heading,
            justify=column.justify,
            no_wrap=place not in widths,
            overflow="fold" if place in widths else "ellipsis",
            width=widths.get(place),
            vertical="bottom",
        )
    for title, rows in sections:
        if title is not None:
            made.add_row(title)
        for row in rows:
            made.add_row(*row)
        if apart:
            made.add_section()
    return made


def axis(measure: str) -> str:
    """The heading of a strip chart: 0 at its left end, 1 at its right."""
    return f"{measure}\n0" + "0.5".center(STRIP - 2) + "1"


def _text(value: Text | str) -> Text:
    """As it stands: a parameter like `speeds=[20]` is no markup."""
    return value if isinstance(value, Text) else Text(value)


def cell_heading(axes: Axes) -> str:
    """The heading of a column of cells: the names of the axes that change more than what is observed."""
    names = [axis.name for axis in axes.values() if not axis.perceptual] or list(axes)
    return f"{names[0]}\n× {' × '.join(names[1:])}" if len(names) > 1 else f"\n{names[0]}"


def cell_name(cell: Cell) -> str:
    """A cell in one line: its values in the order of its axes."""
    return " × ".join(written(value) for value in cell.values())


def cell_rows(cells: Iterable[Cell], axes: Axes) -> list[list[tuple[Text, list[Cell]]]]:
    """The rows of a table of cells, grouped by the perceptual axes.

    A group has a row of its own where it has several cells, then a row a cell; each with the cells that it is of. Without
    perceptual axes all cells are one group, which has no row of its own.
    """
    perceptual = [axis.name for axis in axes.values() if axis.perceptual and len(axes) > 1]
    others = [name for name in axes if name not in perceptual]
    found = []
    for values, group in groupby(cells, key=lambda cell: [cell[name] for name in perceptual]):
        own = list(group)
        title = ", ".join(map(written, values))
        whole = [(Text(title, style="bold"), own)] if title and len(own) > 1 else []
        indent = "  " if whole else f"{title} " if title else ""
        names = [" × ".join(written(cell[name]) for name in others) for cell in own]
        found.append([*whole, *((Text(f"{indent}{name}"), [cell]) for name, cell in zip(names, own, strict=True))])
    return found
