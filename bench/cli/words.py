"""Reads the words of the commands that choose no components: names, and `key=value`, each key once."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from cavbench.core import registry
from cavbench.errors import UserError, short


def split(words: Sequence[str], keys: Collection[str], *, names: int) -> tuple[list[str], dict[str, str]]:
    """The names, and the values by their keys.

    Args:
        words: what was typed.
        keys: allowed keys; none for any.
        names: largest number of names.

    Raises:
        UserError: if a key is unknown, given twice or empty, or there are too many names.
    """
    found: list[str] = []
    values: dict[str, str] = {}
    for word in words:
        key, equals, value = word.partition("=")
        if not equals:
            found.append(word)
        elif keys and key not in keys:
            raise UserError(registry.unknown(f"option {short(word)!r}", key, [f"{known}=…" for known in keys]))
        elif key in values:
            raise UserError(f"{short(key)} is given twice")
        elif not value:
            raise UserError(f"{short(word)} has no value")
        else:
            values[key] = value
    if len(found) > names:
        known = ", ".join(f"{key}=…" for key in keys)
        raise UserError(f"cannot read {short(found[names])!r}: this command takes {known or 'column=value'}")
    return found, values
