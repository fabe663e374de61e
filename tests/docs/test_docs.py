"""Every built-in component has a page with a formula and its parameters, which the site reads from the code."""

from __future__ import annotations

import re
import shlex
import textwrap
import tomllib
from importlib import metadata
from itertools import takewhile
from pathlib import Path

import pytest
import yaml

from cavbench.cli.explain import GLOSSARY
from cavbench.core.options import Options
from cavbench.core.registry import GROUPS, KINDS, Kind, all_grids, entries
from cavbench.run import options
from cavbench.run.config_file import expanded
from docs.figures.__main__ import FIGURES
from docs.prose import findings
from tests.tree import ROOT

DOCS = ROOT / "docs"
FOLDERS: dict[Kind, str] = {"attack": "attacks", "defense": "defenses", "victim": "victims", "world": "worlds"}
BUILT_IN = [
    (kind, name)
    for kind in KINDS
    for name, claims in entries(GROUPS[kind]).items()
    if claims[0].distribution == "cavbench"
]


@pytest.mark.parametrize(("kind", "name"), BUILT_IN)
def test_every_component_has_a_page(kind: Kind, name: str) -> None:
    page = f"{FOLDERS[kind]}/{name}"
    text = (DOCS / f"{page}.md").read_text()
    assert text.startswith(f"# `{name}`")
    assert re.search(r"^\$\$ .+ \$\$$", text, re.MULTILINE), "no formula"
    assert f"```{{component}} {kind}\nbench list {name}\n```" in text
    assert f"```{{pages}} {FOLDERS[kind]}\n" in (DOCS / "index.md").read_text(), "not in the table of contents"


@pytest.mark.parametrize("file", sorted(file for file in FIGURES if file.partition("_")[0] in KINDS))
def test_the_figure_of_a_component_is_on_its_page(file: str) -> None:
    kind, _, name = file.rpartition(".")[0].partition("_")
    page = (DOCS / f"{kind}s" / f"{name}.md").read_text()
    assert re.search(rf"!\[.+\]\(\.\./images/{re.escape(file)}\)", page)
    assert (DOCS / "images" / file).is_file()


WRITTEN_ELSEWHERE = {"plugins.md", "gymnasium.md", "changelog.md"}
"""Pages whose commands need a plug-in that another test writes, or belong to earlier versions."""
PLACEHOLDERS = ("…", "=N", "my_", "NAME", "$SLURM")


def _commands(page: Path) -> list[list[str]]:
    """Every `bench ...` of a page, in code blocks and in the text."""
    text = re.sub(r"\\\n\s*", "", page.read_text())
    blocks = re.findall(r"^(?:    +|\$ )?(bench .+)$", text, re.M)
    return [shlex.split(one, comments=True) for one in (*blocks, *re.findall(r"(?<!`)`(bench [^`]+)`", text))]


def _check_names(words: list[str], *, train: bool) -> None:
    axes = [] if train else [axis for grid in all_grids() for axis in grid.axes]
    settings = options.TrainOptions if train else options.RunOptions
    Options(words, kinds=KINDS, settings=settings, axes=axes).check_names()


def test_every_command_in_the_documentation_names_what_exists() -> None:
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.rglob("*.md")]
    checked = 0
    for page in (page for page in pages if page.name not in WRITTEN_ELSEWHERE and "_build" not in page.parts):
        for _, name, *words in _commands(page):
            if any(placeholder in word for word in words for placeholder in PLACEHOLDERS):
                continue
            if name in ("run", "audit", "train"):
                own = takewhile(lambda word: word not in ("|", ">"), words)
                given = [word for word in own if not word.startswith(("--", "salt="))]
                _check_names(given, train=name == "train")
            elif name in ("list", "check") and words and words[0].isidentifier():
                assert any(words[0] in entries(GROUPS[kind]) for kind in KINDS) or words[0] in (*KINDS, "standard")
            checked += 1
    assert checked > 100


def test_the_workflow_runs_a_command_whose_file_is_beside_it() -> None:
    steps = yaml.safe_load((DOCS / "ci" / "robustness.yml").read_text())["jobs"]["robustness"]["steps"]
    (line,) = [step["run"] for step in steps if step.get("run", "").startswith("bench ")]
    _, name, *words = shlex.split(line)
    assert name == "run"
    found = expanded([word.replace("config=", f"config={DOCS / 'ci'}/") for word in words])
    _check_names(found, train=False)
    assert {"fail_below=0.6", "against=baseline", "junit=robustness.xml"} <= set(found)


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md"])
def test_pages_outside_of_the_site_link_to_existing_targets(name: str) -> None:
    links = re.findall(r"\]\((?!https?:)([^)#]+)", (ROOT / name).read_text())
    assert links
    assert [link for link in links if not (ROOT / link).exists()] == []


@pytest.mark.slow
def test_the_site_reads_the_code_and_refuses_unknown_names(tmp_path: Path) -> None:
    from sphinx.application import Sphinx

    source, built = tmp_path / "docs", tmp_path / "built"
    source.mkdir()
    (source / "index.md").write_text(
        "# Page\n\n$$ \\frac{a}{b} $$\n\n$\\nosuchcommand$\n\n[ranking](../leaderboard/index.html)\n\n"
        "```{component} attack\nbench list noise\n```\n\n```{component} attack\nbench list nois\n```\n\n"
        "```{terms}\nbench help\n```\n\n```{published-rows}\nbench report leaderboard\n```\n\n"
        "```{pages} attacks\n:caption: Attacks\n```\n"
    )
    (source / "attacks").mkdir()
    (source / "attacks" / "mine.md").write_text("# `mine`: found without an entry\n")
    (tmp_path / "leaderboard").mkdir()
    (tmp_path / "leaderboard" / "index.html").write_text("<p>ranks</p>")
    (warned := tmp_path / "warned").touch()
    with warned.open("w") as warning:
        app = Sphinx(source, DOCS, built, tmp_path / "doctrees", "html", status=None, warning=warning)
        app.build()
    page = (built / "index.html").read_text()
    assert re.search(r"<mfrac>\s*<mi>a</mi>\s*<mi>b</mi>", page)
    assert f"cavbench {metadata.version('cavbench')}" in page
    row = re.search(r"attack\.distribution.*?</tr>", page, re.DOTALL)
    assert row
    assert "<p>uniform</p>" in row[0]
    assert "one of uniform, gaussian" in row[0]
    assert re.search(r"<dt>budget</dt><dd><p>The size of the perturbation set", page)
    assert 'href="leaderboard/index.html"' in page
    assert (built / "leaderboard" / "index.html").read_text() == "<p>ranks</p>"
    assert 'href="attacks/mine.html">mine</a>' in page
    complaints = warned.read_text()
    assert "unknown attack 'nois'; did you mean 'noise'?" in complaints
    assert r'Unknown LaTeX command "\nosuchcommand"' in complaints


@pytest.mark.slow
def test_links_to_studies_lead_to_their_copies_in_the_site(tmp_path: Path) -> None:
    from sphinx.application import Sphinx

    for folder in ("docs", "studies"):
        (tmp_path / folder).mkdir()
    (tmp_path / "docs" / "index.md").write_text("# Page\n\n[notes](../studies/notes.md), [lost](../studies/lost.md)\n")
    (tmp_path / "studies" / "notes.md").write_text("# What was tried\n")
    (warned := tmp_path / "warned").touch()
    with warned.open("w") as warning:
        Sphinx(
            tmp_path / "docs", DOCS, tmp_path / "site", tmp_path / "trees", "html", status=None, warning=warning
        ).build()
    assert 'href="studies/notes.md"' in (tmp_path / "site" / "index.html").read_text()
    assert (tmp_path / "site" / "studies" / "notes.md").read_text() == "# What was tried\n"
    assert "studies/lost" in warned.read_text()


def test_every_term_of_bench_help_has_a_page_and_keeps_the_rules_of_prose() -> None:
    for name, entry in tomllib.loads(GLOSSARY.read_text(encoding="utf-8")).items():
        assert (DOCS / f"{entry['page']}.md").is_file(), name
        assert list(findings(textwrap.fill(entry["meaning"], 120))) == [], name
