"""The one exception that the command line turns into one clear line and a non-zero exit."""

from __future__ import annotations


class UserError(Exception):
    """Bad input: the message says in one line what was wrong, what is allowed and, where it helps, what to type instead."""


def reason(error: BaseException) -> str:
    """Kind and first line of an exception: why something failed, in one line."""
    return f"{type(error).__name__}: {error}".splitlines()[0]
