"""`bench report html=PAGE`: the leaderboards as one HTML file that opens from disk, and as JSON and CSV beside it."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from importlib.resources import files
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from urllib.parse import quote

import jinja2
import pyarrow as pa
import pyarrow.compute as pc
from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from bench.errors import UserError
from bench.files import whole
from bench.plugins.contracts import TRACKS, Track
from bench.records import store as results
from bench.statistics.episodes import unit_interval
from leaderboard import thesis_page
from leaderboard.document import document, table
from leaderboard.entries import MEASUREMENTS, METRICS
from leaderboard.flags import FLAGS
from leaderboard.layout import STRIP, Column, Section, axis, fitted
from leaderboard.published import published
from leaderboard.ranking import Board, Row, read_boards
from leaderboard.text import ATTACKED, BLIND, CLEAN, component, estimate, strip, varying, verdict

NAME = "leaderboard.html"


def leaderboard_report(records: Mapping[Track, pa.Table], console: Console) -> None:
    """Print the ranking of every threat model, with the flags that have fired.

    Args:
        records: by track (`bench.records.store.SCHEMAS`).
        console: where to print.
    """
    print_boards(read_boards(records)[0], console)


def write(out: Path | None, page: Path, console: Console) -> None:
    """Write the page, the JSON and the CSV of a results folder, and print the ranking.

    Args:
        out: results folder; None takes the records that are published with the package.
        page: where to write; in a folder it is called `leaderboard.html`.
        console: where to print.

    Raises:
        UserError: if there are no records, or nothing can be written.
    """
    page = page / NAME if page.is_dir() else page
    # The thesis' tables are made of other records, and so in a process of their own meanwhile.
    with ProcessPoolExecutor(1, get_context("spawn")) as beside:
        beside.submit(thesis_page.prepare)
        records = {track: published(track) for track in TRACKS} if out is None else _read(out)
        thesis = beside.submit(thesis_page.chapters, {track: _for_thesis(records, track) for track in TRACKS})
        boards, entries = read_boards(records)
        made = document(boards, entries, out)
        texts = {
            page.with_suffix(".json"): json.dumps(made, separators=(",", ":"), allow_nan=False) + "\n",
            page.with_suffix(".csv"): table(made),
            page: html(made, sum(map(len, records.values())), thesis.result(), _link(out, page)),
        }
    try:
        page.parent.mkdir(parents=True, exist_ok=True)
        for path, text in texts.items():
            with whole(path) as file:
                file.write(text.encode())
    except OSError as error:
        raise UserError(f"the page {page} cannot be written: {error.strerror}") from error
    print_boards(boards, console)
    for path in sorted(texts):
        console.print(Text(f" {path} ({path.stat().st_size / 1e6:.2f} MB)"), soft_wrap=True)


def _read(out: Path) -> dict[Track, pa.Table]:
    return results.read_compact(out, {name for names in MEASUREMENTS.values() for name in names})


def html(made: Mapping[str, Any], episodes: int, thesis: Sequence[thesis_page.Chapter], recordings: str) -> str:
    """The page of a document.

    Args:
        made: by `document`.
        episodes: how many it is made of.
        thesis: its tables beside ours.
        recordings: the way from the page to the results folder.
    """
    site = files("leaderboard") / "site"
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, undefined=jinja2.StrictUndefined)
    template = environment.from_string((site / "page.html").read_text(encoding="utf-8"))
    # "<" would end the element that the data stand in.
    data = json.dumps({**made, "recordings": recordings}, separators=(",", ":"), allow_nan=False).replace(
        "<", "\\u003c"
    )
    return template.render(
        css=jinja2.utils.markupsafe.Markup((site / "page.css").read_text(encoding="utf-8")),
        js=jinja2.utils.markupsafe.Markup((site / "page.js").read_text(encoding="utf-8")),
        data=jinja2.utils.markupsafe.Markup(data),
        made=made["made"][:10],
        version=made["cavbench"],
        episodes=f"{episodes:,}",
        tracks=[track for track in TRACKS if any(board["track"] == track for board in made["boards"])],
        flags=[{"title": title, "meaning": find.__doc__} for title, find in FLAGS.values()],
        thesis=thesis,
    )


def _link(out: Path | None, page: Path) -> str:
    """The way from the page to the results folder, as the beginning of a link."""
    if out is None:
        return ""
    return quote(Path(os.path.relpath(out.resolve(), page.resolve().parent)).as_posix()) + "/"


def _for_thesis(records: Mapping[Track, pa.Table], track: Track) -> pa.Table:
    """The records that the thesis has a number for; those of detection with their text as text."""
    found = records.get(track)
    if found is None:
        return results.SCHEMAS[track].empty_table()
    if track == "driving":
        alike = pc.and_(
            pc.equal(found["weather"], "clear"),
            pc.is_in(found["attack"].cast(pa.string()), pa.array(["none", "zo", "noise"])),
        )
        return found.filter(
            pc.and_(alike, pc.or_(pc.equal(found["attack"], "none"), pc.equal(found["threat_norm"], "linf")))
        )
    for field in found.schema:
        if pa.types.is_dictionary(field.type):
            place = found.schema.get_field_index(field.name)
            found = found.set_column(place, field.name, found[field.name].cast(field.type.value_type))
    return found


def print_boards(boards: Sequence[Board], console: Console) -> None:
    """Print the leaderboard of each threat model."""
    for board in boards:
        norm, budget, access, queries = board.threat
        title = Text.assemble(
            (board.track, "bold"), f" in {board.world[0]}, {norm} {budget:g}, access {access}, {queries} queries"
        )
        console.print(Padding(title, (1, 1)))
        console.print(Padding(fitted(_columns(board), [Section(board.rows)], console), (0, 1)))
        for name, drive in board.references.items():
            score = estimate(unit_interval(drive.column(METRICS[board.track])), style=BLIND)
            console.print(Padding(Text.assemble(f"{name}: ", score), (0, 3)))
        for row in board.rows:
            if row.flagged:
                titles = "; ".join(FLAGS[flag.name][0] for flag in row.flags if flag.fired)
                console.print(
                    Padding(Text.assemble(("flagged ", "yellow"), f"{_name(row, board)}: ", (titles, "dim")), (0, 1))
                )
    console.print()


def _name(row: Row, board: Board) -> str:
    kinds = ("defense", "victim")
    entries = [one.entries[0] for one in board.rows]
    return " ".join(component(row.entries[0], kind, varying(entries, kind)) for kind in kinds)


def _columns(board: Board) -> list[Column[Row]]:
    shown = {kind: varying([row.entries[0] for row in board.rows], kind) for kind in ("attack", "defense", "victim")}
    measure = "safe progress" if board.track == "driving" else "confidence"
    columns: list[Column[Row]] = [
        Column("rank", lambda row: str(row.group)),
        Column("defence", lambda row: component(row.entries[0], "defense", shown["defense"]), "left", folds=True),
        Column("victim", lambda row: component(row.entries[0], "victim", shown["victim"]), "left", folds=True),
        Column(f"{measure}\nworst [95 %]", lambda row: estimate(row.worst.score, style=ATTACKED), "left"),
        Column("\nclean", lambda row: estimate(row.clean, style=CLEAN), "left", spare=3),
    ]
    if board.track == "driving":
        columns.append(Column("beats\nblind", lambda row: verdict(row.worst.lead)))
    return [
        *columns,
        Column("strongest\nattack", lambda row: str(row.identity["attack"]), "left"),
        Column("flags", _fired),
        Column(axis(measure), lambda row: strip({ATTACKED: row.worst.score, CLEAN: row.clean}, STRIP), "left", spare=9),
    ]


def _fired(row: Row) -> Text:
    count = sum(bool(flag.fired) for flag in row.flags)
    return Text(str(count), style="yellow") if count else Text("")
