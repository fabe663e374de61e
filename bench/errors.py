"""The exception that the command line prints as one line, with a non-zero exit code."""

from __future__ import annotations


class UserError(Exception):
    """Bad input. The message is one line: what was wrong, what is allowed and, if it helps, what to type instead."""


def reason(error: BaseException) -> str:
    """The type and the first line of an exception: why something failed, in one line."""
    return f"{type(error).__name__}: {error}".splitlines()[0]
