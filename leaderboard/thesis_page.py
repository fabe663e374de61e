"""The tables of the thesis beside ours, as the page shows them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pyarrow as pa
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bench.plugins.contracts import Track
from leaderboard.thesis_numbers import THESIS, printed

Chapter = dict[str, Any]
"""`name`, `heading` and `tables`, each with its `title`, `headings`, `rows` and `notes`."""


def prepare() -> None:
    """Import what the tables need."""
    from scipy import stats  # noqa: F401

    from leaderboard import thesis_driving, thesis_patches  # noqa: F401


def chapters(own: Mapping[Track, pa.Table]) -> list[Chapter]:
    """The tables of the thesis beside ours.

    Args:
        own: the user's records, by track; where they have none, those published with the package are read.
    """
    from leaderboard import thesis_driving, thesis_patches

    numbers = printed()
    found = (
        ("Chapter 3", thesis_patches.heading(), thesis_patches.tables(numbers, own["detection"], Console(width=400))),
        ("Chapter 4", thesis_driving.heading(numbers["max_reward"]), thesis_driving.tables(numbers, own["driving"])),
    )
    return [
        {
            "name": name,
            "heading": heading.plain,
            "tables": [
                {
                    "title": beside.section["title"],
                    **_cells(beside.table),
                    "notes": [
                        *(note.plain for note in beside.notes),
                        *(f"Thesis: {check}" for check in beside.section["check"]),
                        *(f"Missing: {command}" for command in beside.missing),
                    ],
                }
                for beside in tables
            ],
        }
        for name, heading, tables in found
    ]


def _cells(made: Table) -> dict[str, Any]:
    """The headings and the cells of a terminal's table."""

    def cell(value: object) -> dict[str, object]:
        text = value if isinstance(value, Text) else Text(str(value))
        styles = {str(text.style), *(str(span.style) for span in text.spans)}
        return {"text": text.plain, "theirs": THESIS in styles}

    rows = [[cell(value) for value in row] for row in zip(*(column.cells for column in made.columns), strict=True)]
    return {
        "headings": [str(column.header) for column in made.columns],
        "rows": [{"cells": row, "title": not any(one["text"] for one in row[1:])} for row in rows],
    }
