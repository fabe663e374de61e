"""The reports as data: what `--json`, `json=`, `csv=` and `latex=` write of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa

from cavbench.documents import Report
from cavbench.leaderboard.page.document import document
from cavbench.leaderboard.page.pairs import describe_track
from cavbench.leaderboard.page.run_document import run_content
from cavbench.leaderboard.page.table import latex, pairs_latex, pairs_table, table, worlds_latex, worlds_table
from cavbench.leaderboard.page.worlds import world_boards
from cavbench.leaderboard.published import every_track
from cavbench.leaderboard.ranking.boards import read_boards
from cavbench.leaderboard.ranking.published_worlds import published_worlds, read_worlds
from cavbench.leaderboard.ranking.worlds import over_several


def _leaderboard(records: Mapping[str, pa.Table], folder: Path | None) -> dict[str, Any]:
    boards, comparisons = read_boards(records or every_track())
    worlds = over_several(boards) if records else published_worlds(boards)
    return document(boards, comparisons, folder, worlds=worlds)


def _beside(records: Mapping[str, pa.Table], folder: Path | None) -> dict[str, Any]:
    boards, comparisons = read_boards(records, every_track(worlds=True))
    return document(boards, comparisons, folder, worlds=over_several(boards))


def _worlds(records: Mapping[str, pa.Table], folder: Path | None) -> dict[str, Any]:
    found = read_worlds(records)
    tracks = {one.track.name: describe_track(one.track) for one in found}
    return {"tracks": tracks, "worlds": world_boards(found)}


RUN = Report(content=run_content, csv=pairs_table, latex=pairs_latex)
LEADERBOARD = Report(content=_leaderboard, csv=table, latex=latex)
WORLDS = Report(content=_worlds, csv=worlds_table, latex=worlds_latex)
BESIDE = Report(content=_beside, csv=table, latex=latex)
