"""The reports as data: what `--json`, `json=`, `csv=` and `latex=` write of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa

from cavbench.documents import Report
from cavbench.leaderboard.page.document import document
from cavbench.leaderboard.page.run_document import run_content
from cavbench.leaderboard.page.table import latex, pairs_latex, pairs_table, table
from cavbench.leaderboard.published import every_track
from cavbench.leaderboard.ranking.boards import read_boards


def _leaderboard(records: Mapping[str, pa.Table], folder: Path | None) -> dict[str, Any]:
    boards, comparisons = read_boards(records or every_track())
    return document(boards, comparisons, folder)


def _beside(records: Mapping[str, pa.Table], folder: Path | None) -> dict[str, Any]:
    boards, comparisons = read_boards(records, every_track())
    return document(boards, comparisons, folder)


RUN = Report(content=run_content, csv=pairs_table, latex=pairs_latex)
LEADERBOARD = Report(content=_leaderboard, csv=table, latex=latex)
BESIDE = Report(content=_beside, csv=table, latex=latex)
