"""Sphinx extension of the site: what is read from code and records, MathML formulas, docstrings, the leaderboard's page."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any, get_args

from docutils import nodes
from docutils.statemachine import StringList
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from glossary_terms import TermsDirective
from published_rows import PublishedRowsDirective
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.directives.other import TocTree
from sphinx.ext.napoleon import GoogleDocstring
from sphinx.util import logging
from sphinx.util.docutils import SphinxDirective

from cavbench.cli.listing import fits
from cavbench.core import registry
from cavbench.core.parameters import parameters
from cavbench.core.registry import GROUPS, Kind
from cavbench.core.track import tracks
from cavbench.errors import UserError
from cavbench.leaderboard.ranking.columns import all_columns

LEADERBOARD = tuple(f"leaderboard/index.{kind}" for kind in ("html", "json", "csv", "tex"))
"""Files that `make page` builds; they are copied to the same path in the site, with the films beside them."""

logger = logging.getLogger(__name__)


class ComponentDirective(SphinxDirective):
    """The text of `bench list NAME`: module, package, track and parameters of a component.

    The argument is the kind of component. The content is the command line, so a reader of the plain Markdown sees what to type.
    """

    required_arguments = 1
    has_content = True

    def run(self) -> list[nodes.Node]:
        (kind,), name = self.arguments, " ".join(self.content).removeprefix("bench list ")
        if kind not in get_args(Kind):
            raise self.error(f"unknown kind of component {kind!r}; known: {', '.join(get_args(Kind))}")
        try:
            text = described(kind, name)
        except UserError as error:
            raise self.error(str(error)) from error
        found = self.parse_text_to_nodes(text)
        for table in (node for node in found if isinstance(node, nodes.table)):
            table["classes"].append("parameters")
        return found


class PagesDirective(TocTree):
    """A table of contents with every page of a folder, by the name of its file. A new page needs no entry."""

    required_arguments = 1
    has_content = False

    def run(self) -> list[nodes.Node]:
        (folder,) = self.arguments
        pages = sorted(path.stem for path in (Path(self.env.srcdir) / folder).glob("*.md"))
        self.content = StringList([f"{page} <{folder}/{page}>" for page in pages], source=self.env.docname)
        return super().run()


class ColumnsDirective(SphinxDirective):
    """The columns of the leaderboard, from the one list that makes them (`cavbench.leaderboard.ranking.columns`)."""

    def run(self) -> list[nodes.Node]:
        return self.parse_text_to_nodes(described_columns())


def described_columns() -> str:
    """The columns of every track's leaderboard as a table in Markdown."""
    lines = ["| column | in tables | meaning |", "|---|---|---|"]
    found = [column for track in tracks() for column in all_columns(track)]
    for name in dict.fromkeys(column.name for column in found):
        alike = [column for column in found if column.name == name]
        names = f"`{name}`, `{name}_low`, `{name}_high`" if alike[0].interval else f"`{name}`"
        titles = " or ".join(dict.fromkeys(column.title for column in alike if column.shown))
        meanings = "; ".join(dict.fromkeys(column.meaning for column in alike))
        lines.append(f"| {names} | {titles} | {meanings} |")
    return "\n".join(lines)


def described(kind: Kind, name: str) -> str:
    """A component in Markdown: a paragraph and a table of its parameters, or of the choices of an adapter.

    Raises:
        UserError: if the component is unknown or its plug-in is broken.
    """
    entry = registry.find(GROUPS[kind], name, kind)
    shipped = f"`{entry.target}`, {entry.shipped_by}."
    if offered := registry.offers(kind, name):
        rows = [f"| `{name}:{choice}` | {word} |" for choice, word in offered.items()]
        return "\n".join((shipped, "", "| name | |", "|---|---|", *rows))
    component = registry.load(kind, name)
    known = parameters(component).values()
    lines = [f"{shipped} {fits(kind, component)}"]
    if not known:
        return f"{lines[0]} It has no parameters."
    lines += ["", "| parameter | type | default | meaning |", "|---|---|---|---|"]
    for parameter in known:
        meaning = "; ".join(filter(None, (parameter.meaning.rstrip("."), parameter.allowed)))
        cells = (f"`{kind}.{parameter.name}`", parameter.type_name, parameter.default_text, meaning)
        lines.append("| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |")
    return "\n".join(lines)


def _formula(translator: Any, node: nodes.math | nodes.math_block) -> None:
    """Write a formula as MathML, which browsers render natively; an invalid formula is a warning."""
    block = isinstance(node, nodes.math_block)
    try:
        mathml = tex2mathml(node.astext(), as_block=block)
    except MathError as error:
        logger.warning("the formula %r cannot be read: %s", node.astext(), error, location=node)
        raise nodes.SkipNode from error
    translator.body.append(f'<div class="math">{mathml}</div>\n' if block else mathml)
    raise nodes.SkipNode


def _google_style(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Read `Args:` sections. Attributes are skipped, because napoleon takes all text before a colon for a type."""
    if what not in ("attribute", "data", "property"):
        lines[:] = GoogleDocstring(lines, what=what, name=name, obj=obj, options=options).lines()


def _link_leaderboard(app: Sphinx, doctree: nodes.document) -> None:
    """Point links to the leaderboard's files at the copies in the site; Sphinx would make them downloads."""
    up = "../" * app.env.docname.count("/")
    for link in list(doctree.findall(addnodes.download_reference)):
        target = link["reftarget"].lstrip("./")
        if target in LEADERBOARD:
            link.replace_self(nodes.reference("", "", *link.children, refuri=up + target, internal=True))


STUDIES = "studies"
"""The lab book beside `docs`. Its Markdown is copied as it is, and is no part of the contents."""


def _link_studies(app: Sphinx, doctree: nodes.document) -> None:
    """Point links to the lab book at its copy in the site. Sphinx looks for a page, and warns if there is no such file."""
    up, folder = "../" * app.env.docname.count("/"), (app.srcdir.parent / STUDIES).resolve()
    for link in list(doctree.findall(addnodes.pending_xref)):
        file = (app.srcdir / f"{link['reftarget']}.md").resolve()
        if file.parent == folder and file.is_file():
            link.replace_self(
                nodes.reference("", "", *link.children, refuri=f"{up}{STUDIES}/{file.name}", internal=True)
            )


def _copy_studies(app: Sphinx, failure: Exception | None) -> None:
    target = Path(app.outdir) / STUDIES
    for page in (app.srcdir.parent / STUDIES).glob("*.md") if failure is None else ():
        target.mkdir(exist_ok=True)
        shutil.copyfile(page, target / page.name)


def _copy_leaderboard(app: Sphinx, failure: Exception | None) -> None:
    for name in LEADERBOARD if failure is None else ():
        source, target = app.srcdir.parent / name, Path(app.outdir) / name
        # If a file is missing, Sphinx warns on the pages that link it.
        if source.exists():
            target.parent.mkdir(exist_ok=True)
            # The page links the pages beside it, wherever the site lies.
            target.write_text(source.read_text(encoding="utf-8").replace('"docs":""', '"docs":"../"'), encoding="utf-8")
    films = app.srcdir.parent / "leaderboard" / "clips"
    if failure is None and films.is_dir():
        shutil.copytree(films, Path(app.outdir) / "leaderboard" / "clips", dirs_exist_ok=True)


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.add_directive("component", ComponentDirective)
    app.add_directive("terms", TermsDirective)
    app.add_directive("published-rows", PublishedRowsDirective)
    app.add_directive("pages", PagesDirective)
    app.add_directive("leaderboard-columns", ColumnsDirective)
    app.add_html_math_renderer("mathml", inline_renderers=(_formula, None), block_renderers=(_formula, None))
    app.connect("autodoc-process-docstring", _google_style)
    # Before Sphinx collects downloads.
    app.connect("doctree-read", _link_leaderboard, priority=400)
    app.connect("build-finished", _copy_leaderboard)
    app.connect("doctree-read", _link_studies, priority=400)
    app.connect("build-finished", _copy_studies)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
