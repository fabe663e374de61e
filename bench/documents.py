"""What a command says to a machine: one JSON document, whose schema ships with the package and has a version."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from importlib.resources import files
from pathlib import Path
from typing import Any

VERSION = 1
"""Of the schema; a reader that knows it can read every later document of the same version."""
GROUP = "cavbench.documents"
"""The entry points of reports that can be written as data: each a `Report`."""


@dataclass(frozen=True)
class Report:
    """A report as data, for `bench report NAME --json`, `json=`, `csv=` and `latex=`.

    Args:
        content: of the document, from the records by track and their results folder. Both are empty where the report shows
            records that are published with it.
        csv: the table of a document as CSV.
        latex: the same for LaTeX.
    """

    content: Callable[[Mapping[str, Any], Path | None], dict[str, Any]]
    csv: Callable[[Mapping[str, Any]], str]
    latex: Callable[[Mapping[str, Any]], str]


def document(name: str, content: Mapping[str, Any]) -> dict[str, Any]:
    """A document: its content behind what every document has.

    Args:
        name: what kind of document it is, a name in the `$defs` of the schema.
        content: JSON values.
    """
    return {
        "schema": VERSION,
        "document": name,
        "cavbench": metadata.version("cavbench"),
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        **content,
    }


def written(made: Mapping[str, Any], *, indent: int | None = 1) -> str:
    """A document as JSON text. It has no NaN, which JSON does not know: unknown numbers are null."""
    separators = None if indent else (",", ":")
    return json.dumps(made, indent=indent, separators=separators, allow_nan=False) + "\n"


def show(name: str, content: Mapping[str, Any]) -> None:
    """Print a document on standard output, as it is: a console would wrap it."""
    sys.stdout.write(written(document(name, content)))


def schema() -> dict[str, Any]:
    """The JSON schema (draft 2020-12) of all documents."""
    text = (files("cavbench") / "documents.schema.json").read_text(encoding="utf-8")
    return dict(json.loads(text))
