"""The tables of the thesis beside ours, as the page shows them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
from rich.console import Console
from rich.table import Table
from rich.text import Text

from cavbench.core.track import track
from cavbench.detection.track import DetectionTrack
from cavbench.driving.track import DrivingTrack
from cavbench.leaderboard.thesis.numbers import THESIS, printed
from cavbench.leaderboard.thesis.policy_records import clear
from cavbench.records.schema import schema

MEASUREMENTS = frozenset({"return", "safe_progress", "confidence_mean", "location"})
"""The columns of records that the tables read."""
Chapter = dict[str, Any]
"""`name`, `heading` and `tables`, each with its `title`, `headings`, `rows` and `notes`."""


def prepare() -> None:
    """Import what the tables need."""
    from scipy import stats  # noqa: F401

    from cavbench.leaderboard.thesis import patches, policies  # noqa: F401


def chapters(own: Mapping[str, pa.Table]) -> list[Chapter]:
    """The tables of the thesis beside ours.

    Args:
        own: the user's records, by track; where they have none, those published with the package are read.
    """
    from cavbench.leaderboard.thesis import patches, policies

    numbers = printed()
    detection, driving = (
        own.get(name, schema(track(name)).empty_table()) for name in (DetectionTrack.name, DrivingTrack.name)
    )
    found = (
        ("Chapter 3", patches.heading(), patches.tables(numbers, detection, Console(width=400))),
        ("Chapter 4", policies.heading(numbers["max_reward"]), policies.tables(numbers, driving)),
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


def needed(records: Mapping[str, pa.Table]) -> dict[str, pa.Table]:
    """The records that the thesis has a number for; those of patches with their text as text.

    Args:
        records: by track; text may be dictionaries.
    """
    found = {}
    if DrivingTrack.name in records:
        table = clear(records[DrivingTrack.name])
        attacks = pc.is_in(table["attack"].cast(pa.string()), pa.array(["none", "zo", "noise"]))
        budget = pc.or_(pc.equal(table["attack"], "none"), pc.equal(table["threat_norm"], "linf"))
        found[DrivingTrack.name] = table.filter(pc.and_(attacks, budget))
    if DetectionTrack.name in records:
        table = records[DetectionTrack.name]
        plain = [
            field.with_type(field.type.value_type) if pa.types.is_dictionary(field.type) else field
            for field in table.schema
        ]
        found[DetectionTrack.name] = table.cast(pa.schema(plain))
    return found


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
