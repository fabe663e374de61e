"""Rules of the prose that can be counted. `make docs` runs `python docs/prose.py`, and a finding is an error.

It checks README.md, CONTRIBUTING.md and every page, or the pages it is given. A sentence has at most 30 words, a table cell
120 characters. A share is written 0.64, not .64. A line has at most 150 characters: the target of a link does not count, and a
line of a table, an image or a formula has no limit. Code and formulas count as one word.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from markdown_it import MarkdownIt
from markdown_it.token import Token
from mdit_py_plugins.dollarmath import dollarmath_plugin

ROOT = Path(__file__).parents[1]
WORDS, CELL, LINE = 30, 120, 150
UNDONE: tuple[str, ...] = ()
"""Pages and folders that were written before the rules. It is an error, too, if one of them keeps the rules by now."""

PARSER = MarkdownIt("commonmark").enable("table").use(dollarmath_plugin)
ABBREVIATION = re.compile(r"\b(e\.g|i\.e|et al|cf|vs|Fig|Eq|Eqs|Sec|No|p|pp)\.(?=\s)")
SENTENCE_END = re.compile(r"""[.!?]["'”’)\]]*\s+(?![a-z])""")
BARE_SHARE = re.compile(r"(?<![\w.])\.\d+")


def findings(text: str) -> Iterator[tuple[int, str]]:
    """Each line number, from 1, and what is wrong there, of a page in Markdown."""
    yield from _long_lines(text)
    in_cell, line = False, 1
    for token in PARSER.parse(text):
        in_cell = (in_cell or token.type in ("td_open", "th_open")) and token.type not in ("td_close", "th_close")
        line = token.map[0] + 1 if token.map else line
        if token.type != "inline":
            continue
        read = _text(token, code="`")
        yield from (
            (line + read[: bare.start()].count("\n"), f"{bare[0]}, not 0{bare[0]}")
            for bare in BARE_SHARE.finditer(read)
        )
        if in_cell and (length := len(_text(token))) > CELL:
            yield line, f"a cell of {length} characters, at most {CELL}: {read[:40]!r}"
        for start, sentence in () if in_cell else _sentences(read):
            if (words := sum(any(map(str.isalnum, word)) or "`" in word for word in sentence.split())) > WORDS:
                yield (
                    line + read[:start].count("\n"),
                    f"a sentence of {words} words, at most {WORDS}: {sentence[:60]!r}",
                )


def _long_lines(text: str) -> Iterator[tuple[int, str]]:
    for number, line in enumerate(text.splitlines(), start=1):
        length = len(re.sub(r"\]\([^)]*\)", "]", line))
        if length > LINE and not line.lstrip().startswith(("|", "!", "$$")):
            yield number, f"a line of {length} characters, at most {LINE}"


def _text(inline: Token, code: str | None = None) -> str:
    """The text that a reader sees, its lines as in the source; `code` stands for each piece of code or formula."""
    shown = {"softbreak": "\n", "hardbreak": "\n", "image": "", "html_inline": ""}
    pieces = {"code_inline": code, "math_inline": code}
    return "".join(shown.get(part.type, pieces.get(part.type) or part.content) for part in inline.children or ())


def _sentences(text: str) -> Iterator[tuple[int, str]]:
    """Each sentence with the position of its first character."""
    text = ABBREVIATION.sub(lambda found: found[0].replace(".", "_"), text)
    start = 0
    for end in [*(found.end() for found in SENTENCE_END.finditer(text)), len(text)]:
        yield start, text[start:end]
        start = end


def check(root: Path, undone: Sequence[str] = UNDONE) -> list[str]:
    """All findings of a repository, and the entries of `undone` that have none."""
    complaints, unmet = [], dict.fromkeys(undone, 0)
    pages = [root / "README.md", root / "CONTRIBUTING.md", *sorted((root / "docs").rglob("*.md"))]
    for page in (page for page in pages if "_build" not in page.parts):
        name = page.relative_to(root)
        found = [f"{name}:{line}: {what}" for line, what in findings(page.read_text(encoding="utf-8"))]
        entry = next((entry for entry in undone if name.is_relative_to(entry)), None)
        if entry is None:
            complaints += found
        else:
            unmet[entry] += len(found)
    done = [entry for entry, count in unmet.items() if not count]
    return [*complaints, *(f"docs/prose.py: {entry} keeps the rules: take it from UNDONE" for entry in done)]


def main(pages: Sequence[str]) -> int:
    complaints = check(ROOT) if not pages else []
    for page in pages:
        complaints += [f"{page}:{line}: {what}" for line, what in findings(Path(page).read_text(encoding="utf-8"))]
    sys.stdout.writelines(f"{complaint}\n" for complaint in complaints)
    return 1 if complaints else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
