"""Atomic file writes: a file appears whole or not at all, even if the process is killed; and what a killed process leaves."""

from __future__ import annotations

import hashlib
import os
import platform
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import BinaryIO

from cavbench.errors import UserError


def check_folder(folder: Path, what: str, option: str = "out") -> None:
    """Create a folder, and check that files can be written to it; call it before the work whose results go there.

    Args:
        folder: the folder.
        what: its name in the error.
        option: the option of the command line that chooses it.

    Raises:
        UserError: if it is a file, or cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        reason = "it is a file" if folder.is_file() else error.strerror or str(error)
        raise UserError(f"{what} {folder} cannot be written: {reason}; choose another with {option}=") from None


@contextmanager
def whole(path: Path) -> Iterator[BinaryIO]:
    """Open a binary file that becomes `path`: a temporary file, synced and renamed at the end, deleted if the block raises.

    The first time, the temporary files that killed processes left in the folder are deleted.
    """
    _sweep_once(path.parent)
    handle, aside = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}-{_owner()}", suffix=".tmp")
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


@contextmanager
def scratch(parent: Path | None = None) -> Iterator[Path]:
    """A folder for temporary files, deleted at the end; the first time, those are deleted that killed processes left.

    Args:
        parent: where to make it; None for the folder of the system.
    """
    parent = parent or Path(tempfile.gettempdir())
    _sweep_once(parent)
    folder, own = Path(tempfile.mkdtemp(prefix=f".cavbench-{_owner()}", suffix=".tmp", dir=parent)), os.getpid()
    try:
        yield folder
    finally:
        # A copy of this process (`os.fork`) leaves the folder to the process that made it, and still uses it.
        if os.getpid() == own:
            shutil.rmtree(folder, ignore_errors=True)


@cache
def _sweep_once(folder: Path) -> None:
    sweep(folder)


def sweep(folder: Path) -> None:
    """Delete the temporary files and folders that killed processes of this machine left in a folder."""
    for path in folder.glob(".*.tmp"):
        owner = re.search(f"pid{re.escape(_host())}-(\\d+)-", path.name)
        if owner and not _runs(int(owner[1])):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                with suppress(OSError):
                    path.unlink()


def _owner() -> str:
    """What the names of temporary files say about the process that writes them."""
    return f"pid{_host()}-{os.getpid()}-"


@cache
def _host() -> str:
    """Distinguishes machines that share a folder: their processes have the same numbers."""
    return hashlib.sha256(platform.node().encode()).hexdigest()[:8]


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
