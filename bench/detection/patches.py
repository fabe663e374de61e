"""Crafted patches in a results folder: a safetensors file each, whole or not there, found by the fingerprint of its crafting.

Beside the patch a file holds how it came about, if its attack reported that: `steps`, `moments` and a `loss.NAME` each.
"""

from __future__ import annotations

from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from bench import files
from bench.detection.threat import Evolution, Patch
from bench.errors import UserError
from bench.plugins.fingerprint import canonical
from bench.run.unit import Crafting

FOLDER = "patches"
MEASURED = ("queries", "gradients", "zero_gradients", "seconds", "excess")
LOSS = "loss."


def path_of(out: Path, fingerprint: str) -> Path:
    """Where the patch of a crafting is."""
    return out / FOLDER / f"{fingerprint}.safetensors"


def write(out: Path, crafting: Crafting, patch: Patch) -> Path:
    """Write a patch, with what made it and what it cost, and return the file; it appears whole or not at all."""
    path = path_of(out, crafting.fingerprint)
    measured = {name: repr(getattr(patch, name)) for name in MEASURED}
    tensors = {} if patch.texels is None else {"patch": patch.texels.contiguous()}
    blob = save(
        tensors | _tensors(patch.evolution),
        {"made_by": canonical(crafting.origin), "sha256": patch.sha256} | measured,
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
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            patch = Patch(
                texels=tensors.get("patch"),
                queries=int(said["queries"]),
                gradients=int(said["gradients"]),
                zero_gradients=int(said.get("zero_gradients", 0)),
                seconds=float(said["seconds"]),
                excess=float(said["excess"]),
                evolution=_evolution(tensors),
            )
    except FileNotFoundError:
        raise UserError(f"the patch {path} is not there; the same run again crafts it") from None
    except (OSError, SafetensorError, KeyError, TypeError, ValueError):
        raise UserError(f"the patch {path} is truncated or foreign; delete it and run again to craft it anew") from None
    if patch.sha256 != said.get("sha256"):
        raise UserError(f"the patch {path} was changed; delete it and run again to craft it anew")
    return patch


def _tensors(evolution: Evolution | None) -> dict[str, Tensor]:
    if evolution is None:
        return {}
    losses = {LOSS + name: values for name, values in evolution.losses.items()}
    return {"steps": evolution.steps, "moments": evolution.texels} | losses


def _evolution(tensors: dict[str, Tensor]) -> Evolution | None:
    if "moments" not in tensors:
        return None
    losses = {name.removeprefix(LOSS): tensors[name] for name in sorted(tensors) if name.startswith(LOSS)}
    return Evolution(tensors["steps"], tensors["moments"], losses)
