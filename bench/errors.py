"""The exception that the command line prints as one line, with a non-zero exit code; warnings; text from strangers."""

from __future__ import annotations

import re
import unicodedata
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

LONGEST = 60
"""A value of a user in a message is cut to so many characters."""
LONGEST_WORD, LONGEST_PATH, LONGEST_LINE = 100, 250, 900
"""The same for the words, the paths and the whole of a message."""


class UserError(Exception):
    """Bad input. The message is one line: what was wrong, what is allowed and, if it helps, what to type instead."""


class PluginError(UserError):
    """A plug-in is broken: it cannot be imported, is not what its entry point says, or cannot be created or loaded.

    A sweep goes on without it.
    """


class RefusedNetworkError(UserError):
    """A network is not what attacks, probes and replays rely on, so its score would be wrong.

    The message continues "NAME is refused:".
    """


class UnfinishedError(UserError):
    """A run went to its end, but some of its units failed.

    Args:
        lines: what failed, one line for each pair and reason.
        finished: fingerprints of the finished units.
        missing: number of units that are not finished.
    """

    def __init__(self, lines: Sequence[str], finished: Sequence[str], missing: int) -> None:
        self.lines, self.finished = tuple(lines), finished
        kept = f"{missing} of {len(finished) + missing} units are not finished, the others are kept"
        if not missing:
            kept = f"the {len(finished)} units of the others are finished"
        if finished:
            self.lines = (f"{lines[0]} ({kept})",) if len(lines) == 1 else (*lines, kept)
        super().__init__("; ".join(self.lines))


class EscapeError(Exception):
    """Foreign code raised what ends a process: its message is the type and the first line of that."""


@contextmanager
def in_one_line() -> Iterator[None]:
    """For scripts: a UserError within the block ends the process with one line and exit code 1, without a traceback."""
    try:
        yield
    except UserError as error:
        raise SystemExit(f"error: {message(error)}") from None


def reason(error: BaseException) -> str:
    """The type and the first line of an exception: why something failed, in one line."""
    if isinstance(error, EscapeError):
        return str(error)
    text = message(error)
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def message(error: BaseException) -> str:
    """The first line of an exception's message; empty if it has none, or cannot be written."""
    try:
        return next(iter(str(error).strip().splitlines()), "")
    # Foreign code may say how its exceptions are written, and may end the process there.
    except BaseException:
        return ""


class Notice(UserWarning):
    """Something that the user should know and that stops nothing. The command line prints it as one line."""


def notice(line: str) -> None:
    """Give a notice."""
    warnings.warn(line, Notice, stacklevel=2)


def short(value: str) -> str:
    """A value of a user for a message: on one line, and cut in the middle if it is long."""
    line = " ".join(value.split())
    return line if len(line) <= LONGEST else f"{_cut(line, LONGEST)} ({len(line)} characters)"


def bounded(line: str) -> str:
    """A message on one line: each word that is longer than a path is cut, and the whole in its middle."""
    words = (
        word if len(word) <= (LONGEST_PATH if "/" in word else LONGEST_WORD) else _cut(word, LONGEST)
        for word in line.split()
    )
    return _cut(" ".join(words), LONGEST_LINE)


def _cut(text: str, longest: int) -> str:
    half = longest // 2
    return text if len(text) <= longest else f"{text[:half]}…{text[-half:]}"


def plain(text: str) -> str:
    """Text from a stranger without what a terminal obeys: control characters, also of C1, marks of direction, line separators.

    Line ends and tabs stay. Every other character of the Unicode categories Cc, Cf, Cs, Zl and Zp becomes a question mark.
    """
    return _OBEYED.sub(
        lambda found: found[0] if unicodedata.category(found[0]) not in ("Cc", "Cf", "Cs", "Zl", "Zp") else "?", text
    )


def in_markdown(text: str) -> str:
    """Text on one line that Markdown, its tables and HTML show as it is."""
    return _MEANT.sub(lambda found: f"&#{ord(found[0])};", " ".join(plain(text).split()))


_MEANT = re.compile(r"[\\`*_\[\]<>|#&~]")
_OBEYED = re.compile(r"[^\n\t\x20-\x7e]")
