"""The exception that the command line prints as one line, with a non-zero exit code."""

from __future__ import annotations

from collections.abc import Sequence


class UserError(Exception):
    """Bad input. The message is one line: what was wrong, what is allowed and, if it helps, what to type instead."""


class PluginError(UserError):
    """A plug-in is broken: it cannot be imported, is not what its entry point says, or cannot be created or loaded.

    A sweep goes on without it.
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
        if finished:
            self.lines = (f"{lines[0]} ({kept})",) if len(lines) == 1 else (*lines, kept)
        super().__init__("; ".join(self.lines))


class EscapeError(Exception):
    """Foreign code raised what ends a process: its message is the type and the first line of that."""


def reason(error: BaseException) -> str:
    """The type and the first line of an exception: why something failed, in one line."""
    if isinstance(error, EscapeError):
        return str(error)
    text = str(error).strip()
    return f"{type(error).__name__}: {text}".splitlines()[0] if text else type(error).__name__
