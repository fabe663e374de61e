"""`bench report html=PAGE`: the leaderboards as one HTML file that opens from disk, and as JSON, CSV and LaTeX beside it."""

from __future__ import annotations

import base64
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from importlib import metadata
from importlib.resources import files
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import jinja2
import pyarrow as pa
from rich.console import Console
from rich.text import Text

from cavbench import documents
from cavbench.core.track import tracks
from cavbench.errors import UserError
from cavbench.files import check_folder, whole
from cavbench.leaderboard.comparisons.reading import measurements
from cavbench.leaderboard.page.document import document
from cavbench.leaderboard.page.table import latex, table
from cavbench.leaderboard.published import every_track
from cavbench.leaderboard.ranking.boards import read_boards
from cavbench.leaderboard.ranking.flags import FLAGS
from cavbench.leaderboard.ranking.published_worlds import published_worlds
from cavbench.leaderboard.ranking.worlds import over_several
from cavbench.leaderboard.terminal.ranking import print_boards
from cavbench.leaderboard.terminal.worlds import print_worlds
from cavbench.leaderboard.thesis import chapters
from cavbench.records import reading
from cavbench.run.process import follow_parent

NAME = "leaderboard.html"


def write_beside(out: Path | None, page: Path, console: Console) -> None:
    """The same with the published rows beside those of a results folder, which are marked.

    Raises:
        UserError: as `write`; and if there is no results folder, or nothing was attacked.
    """
    if out is None:
        raise UserError("there is no folder results; choose another with out=")
    write(out, page, console, published=every_track(worlds=True))


def write(out: Path | None, page: Path, console: Console, *, published: Mapping[str, pa.Table] | None = None) -> None:
    """Write the page, the JSON, the CSV and the LaTeX tables of a results folder, and print the ranking.

    Args:
        out: results folder; None takes the records that are published with the package.
        page: where to write; in a folder it is called `leaderboard.html`.
        console: where to print.
        published: records whose rows stand beside those of the folder.

    Raises:
        UserError: if there are no records, or nothing can be written.
    """
    page = page / NAME if page.is_dir() else page
    check_folder(page.parent, "the folder of the page", "html")
    if folders := [target for target in _files(page) if target.is_dir()]:
        raise UserError(f"the page {page} cannot be written: {folders[0]} is a folder; choose another with html=")
    # The thesis' tables are made of other records, and so in a process of their own meanwhile.
    with ProcessPoolExecutor(1, get_context("spawn"), initializer=follow_parent) as beside:
        beside.submit(chapters.prepare)
        records = _read(out)
        # The published rows are no records of a user: the thesis' tables have records of their own.
        thesis = beside.submit(chapters.chapters, {} if out is None else chapters.needed(records))
        boards, comparisons = read_boards(records, published)
        worlds = published_worlds(boards) if out is None else over_several(boards)
        content = document(boards, comparisons, out, _link(out, page), worlds=worlds)
        made = documents.document("leaderboard", content)
        texts = {
            _files(page)[0]: documents.written(made, indent=None),
            _files(page)[1]: table(made),
            _files(page)[2]: latex(made),
            page: html(made, sum(map(len, records.values())), thesis.result(), _link(out, page)),
        }
    try:
        for path, text in texts.items():
            with whole(path) as file:
                file.write(text.encode())
        if out is None:
            _copy_films(made, page.parent)
    except OSError as error:
        raise UserError(f"the page {page} cannot be written: {error.strerror}") from error
    print_boards(boards, console)
    print_worlds(worlds, console)
    for path in sorted(texts):
        console.print(Text(f" {path} ({path.stat().st_size / 1e6:.2f} MB)"), soft_wrap=True)


def _copy_films(made: Mapping[str, Any], folder: Path) -> None:
    """Put the published films where the page expects them: beside it."""
    names = {row["clip"] for board in made["boards"] for row in board["rows"] if row["clip"]}
    for name in sorted(map(unquote, names)):
        film, target = (files("cavbench.leaderboard") / name).read_bytes(), folder / name
        if target.exists() and target.read_bytes() == film:
            continue
        target.parent.mkdir(exist_ok=True)
        with whole(target) as file:
            file.write(film)


def _files(page: Path) -> tuple[Path, Path, Path, Path]:
    """The JSON, the CSV, the LaTeX tables and the page."""
    return page.with_suffix(".json"), page.with_suffix(".csv"), page.with_suffix(".tex"), page


def _read(out: Path | None) -> dict[str, pa.Table]:
    """The records of a folder, or the published ones."""
    if out is None:
        return every_track()
    return reading.read_all(out, {name for track in tracks() for name in measurements(track)} | chapters.MEASUREMENTS)


def html(made: Mapping[str, Any], episodes: int, thesis: Sequence[chapters.Chapter], recordings: str) -> str:
    """The page of a document.

    Args:
        made: by `document`.
        episodes: how many it is made of.
        thesis: its tables beside ours.
        recordings: the way from the page to the results folder.
    """
    site = files("cavbench.leaderboard") / "page" / "site"
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, undefined=jinja2.StrictUndefined)
    template = environment.from_string((site / "page.html").read_text(encoding="utf-8"))
    # "<" would end the element that the data stand in.
    data = json.dumps(
        {**made, "recordings": recordings, **addresses()}, separators=(",", ":"), allow_nan=False
    ).replace("<", "\\u003c")
    ranked = list(dict.fromkeys(board["track"] for board in made["boards"]))
    css, js = ((site / name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    return template.render(
        policy=policy(css, js),
        css=jinja2.utils.markupsafe.Markup(css),
        js=jinja2.utils.markupsafe.Markup(js),
        data=jinja2.utils.markupsafe.Markup(data),
        made=made["made"][:10],
        version=made["cavbench"],
        episodes=f"{episodes:,}",
        tracks={name: made["tracks"][name] for name in ranked},
        columns=list(
            {one["title"]: one for board in made["boards"] for one in board["columns"] if one["shown"]}.values()
        ),
        flags=[{"title": title, "meaning": find.__doc__} for title, find in FLAGS.values()],
        thesis=thesis,
    )


def addresses() -> dict[str, str]:
    """Where the documentation and the repository are, from the metadata of the package; empty where they have no address yet.

    The site's copy of the page gets the way to the site's other pages instead (docs/_ext/cavbench_site.py).
    """
    urls = dict(line.split(", ", 1) for line in metadata.metadata("cavbench").get_all("Project-URL") or ())
    docs = urls.get("Documentation", "")
    return {"docs": docs if not docs or docs.endswith("/") else f"{docs}/", "repository": urls.get("Repository", "")}


def policy(css: str, js: str) -> str:
    """The content security policy of the page: its own script and style, films beside it, and nothing else.

    Whatever a name of a stranger may become in it, no other script runs and nothing is sent anywhere.
    """
    style, script = (
        f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'" for text in (css, js)
    )
    films = "img-src 'self' file: data:"
    return f"default-src 'none'; script-src {script}; style-src {style}; {films}; base-uri 'none'; form-action 'none'"


def _link(out: Path | None, page: Path) -> str:
    """The way from the page to the results folder, as the beginning of a link."""
    if out is None:
        return ""
    return quote(Path(os.path.relpath(out.resolve(), page.resolve().parent)).as_posix()) + "/"
