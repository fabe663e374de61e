"""The thesis' numbers, as printed, and how they stand in a table beside ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from rich.table import Table
from rich.text import Text

from cavbench.leaderboard.terminal.text import number

THESIS = "magenta"
"""The colour of what the thesis says."""
PUBLISHED = " †"
"""The mark of records that are published with the package."""


@dataclass(frozen=True)
class Beside:
    """A table of the thesis beside ours.

    Args:
        section: the thesis' numbers: `title`, `rows` and `check`, where they contradict themselves or each other.
        table: theirs and ours.
        notes: what ours say of the thesis' claims.
        missing: the commands that make records that are not there.
    """

    section: Mapping[str, Any]
    table: Table
    notes: Sequence[Text]
    missing: Sequence[str]


def printed() -> dict[str, Any]:
    """The thesis' numbers, as printed (`data/thesis.yaml`)."""
    # Imported here: a page is put together without it, and it takes a tenth of a second.
    from omegaconf import OmegaConf

    text = (files("cavbench.leaderboard") / "data" / "thesis.yaml").read_text(encoding="utf-8")
    found = OmegaConf.to_container(OmegaConf.create(text))
    assert isinstance(found, dict)
    return {str(name): value for name, value in found.items()}


def as_printed(value: float | None, digits: int = 2) -> Text:
    """A number of the thesis; an em dash where it has none."""
    return Text(number(value, digits), style=THESIS if value is not None else "dim")
