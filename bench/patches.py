"""Crafted patches in a results folder: a safetensors file each, whole or not there, found by the fingerprint of its crafting."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from bench import files
from bench.errors import UserError
from bench.fingerprint import canonical
from bench.patch import Patch
from bench.unit import Crafting

FOLDER = "patches"


def path_of(out: Path, fingerprint: str) -> Path:
    """Where the patch of a crafting is."""
    return out / FOLDER / f"{fingerprint}.safetensors"


def write(out: Path, crafting: Crafting, patch: Patch) -> Path:
    """Write a patch, with what made it and what it cost, and return the file; it appears whole or not at all."""
    path = path_of(out, crafting.fingerprint)
    measured = {name: value for name, value in asdict(patch).items() if name != "texels"}
    tensors = {} if patch.texels is None else {"patch": patch.texels.contiguous()}
    blob = save(
        tensors,
        {"made_by": canonical(crafting.origin), "sha256": patch.sha256} | {k: repr(v) for k, v in measured.items()},
    )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with files.whole(path) as file:
            file.write(blob)
    except OSError as error:
        raise UserError(f"the patch {path} cannot be written: {error.strerror}") from error
    return path


def read(out: Path, fingerprint: str) -> Patch:
    """The patch of a crafting.

    Raises:
        UserError: if it is not there, cannot be read, or is not what was written.
    """
    path = path_of(out, fingerprint)
    try:
        with safe_open(path, "pt") as file:
            said = file.metadata()
            patch = Patch(
                texels=file.get_tensor("patch") if "patch" in file.keys() else None,  # noqa: SIM118
                queries=int(said["queries"]),
                gradients=int(said["gradients"]),
                seconds=float(said["seconds"]),
                excess=float(said["excess"]),
            )
    except FileNotFoundError:
        raise UserError(f"the patch {path} is not there; the same run again crafts it") from None
    except (OSError, SafetensorError, KeyError, TypeError, ValueError):
        raise UserError(f"the patch {path} is truncated or foreign; delete it and run again to craft it anew") from None
    if patch.sha256 != said.get("sha256"):
        raise UserError(f"the patch {path} was changed; delete it and run again to craft it anew")
    return patch
