"""The one exception that the command line turns into one clear line and a non-zero exit."""

from __future__ import annotations


class UserError(Exception):
    """Bad input: the message says in one line what was wrong, what is allowed and, where it helps, what to type instead."""
