"""What happens to a file before it is used: its hash, and a trial in a copy of this process."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Hashable
from functools import cache, partial
from pathlib import Path

from cavbench import bounded
from cavbench.errors import UserError
from cavbench.isolation.foreign import harm


class RefusedError(Exception):
    """A part of a file that is not carried out. The message completes "the file is refused:"."""


class OperationError(Exception):
    """An operation of a network failed. The message is its name."""


def hashed(given: str, noun: str) -> str:
    """The sha256 of a file.

    Args:
        given: its path, the parameter `path` of a victim.
        noun: what is in it, for errors.

    Raises:
        UserError: if the file is missing, is no regular file, has more than 1 GiB, or cannot be read.
    """
    path = Path(given).expanduser()
    if not os.path.exists(path):
        raise UserError(f"there is no file {given}; set victim.path=… to the {noun}'s file")
    return bounded.sha256(path, most=bounded.WEIGHTS, name=given)


def refuse_harm(name: str, load: Callable[..., object], *arguments: Hashable) -> None:
    """Read and try a file in a copy of this process first (Linux); once for the same arguments.

    Args:
        name: the file in errors.
        load: reads and tries the file; its exceptions are no harm, because the same call in this process raises them.
        arguments: of `load`.

    Raises:
        UserError: if that ends the process, does not end, or replaces functions of the framework.
    """
    # A worker is itself a process that may end.
    if multiprocessing.parent_process() is None and (why := _harm(load, *arguments)):
        raise UserError(f"{name} is refused: reading and trying it {why}")


@cache
def _harm(load: Callable[..., object], *arguments: Hashable) -> str:
    return harm(partial(load, *arguments))


def failure(error: Exception) -> str:
    """What failed: an operation or, with an exception of another kind, its type."""
    return f"the operation {error}" if isinstance(error, OperationError) else type(error).__name__
