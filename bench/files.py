"""Atomic file writes: a file appears whole or not at all, even if the process is killed."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from bench.errors import UserError


def check_folder(folder: Path, what: str) -> None:
    """Create a folder, and check that files can be written to it; call it before the work whose results go there.

    Raises:
        UserError: if it is a file, or cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        reason = "it is a file" if folder.is_file() else error.strerror or str(error)
        raise UserError(f"{what} {folder} cannot be written: {reason}; choose another with out=") from None


@contextmanager
def whole(path: Path) -> Iterator[BinaryIO]:
    """Open a binary file that becomes `path`: a temporary file, synced and renamed at the end, deleted if the block raises."""
    handle, aside = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}-", suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.chmod(aside, 0o644)
        os.replace(aside, path)
    except BaseException:
        Path(aside).unlink(missing_ok=True)
        raise
