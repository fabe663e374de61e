"""The artefacts in a results folder: a file each, written atomically, named by its fingerprint."""

from __future__ import annotations

from pathlib import Path

from cavbench import bounded, files
from cavbench.errors import UserError
from cavbench.run.unit import Unit


def path_of(out: Path, unit: Unit) -> Path:
    """The file of a unit's artefact, which others may share."""
    artefact = unit.track.artefact
    assert artefact
    return out / artefact[1] / f"{unit.artefact}.safetensors"


def write(out: Path, unit: Unit, content: bytes) -> Path:
    """Write the artefact of a unit atomically, and return its file.

    Raises:
        UserError: if it cannot be written.
    """
    path = path_of(out, unit)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with files.whole(path) as file:
            file.write(content)
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror}") from error
    return path


def read(path: Path) -> bytes:
    """The content of an artefact.

    Raises:
        UserError: if it is missing, or is no regular file of at most 1 GiB.
    """
    if not path.exists():
        raise UserError(f"{path} is missing; run the same command again to create it")
    return bounded.content(path, most=bounded.WEIGHTS)
