"""A crafted patch with its cost and the history of its crafting, and the safetensors file that stores them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from cavbench import bounded
from cavbench.errors import UserError

MOMENTS = 20
"""Largest number of crafting steps kept in an `Evolution`."""
MEASURED = ("queries", "gradients", "zero_gradients", "nan_gradients", "seconds", "excess")
LOSS = "loss."
SITE = "site."


@dataclass(frozen=True)
class Evolution:
    """The history of a crafting: K evenly spaced steps, at most `MOMENTS`.

    Args:
        steps: int64 [K], counted from 0.
        texels: uint8 [K, 3, P, P] sRGB.
        losses: float32 [K] by name; NaN where the attack did not report one.
    """

    steps: Tensor
    texels: Tensor
    losses: Mapping[str, Tensor]


@dataclass(frozen=True)
class Patch:
    """A crafted patch and its cost.

    Args:
        texels: float32 [3, P, P] sRGB in [0, 1]; None for no patch.
        queries: number of images sent to the detector.
        gradients: number of images whose gradient was computed.
        zero_gradients, nan_gradients: number of these gradients that were 0 everywhere, and of those with NaN or infinity.
        seconds: wall time.
        excess: largest distance from the attack's texels to [0, 1], before projection.
        evolution: intermediate patches that the attack reported; None if it reported nothing.
    """

    texels: Tensor | None
    queries: int = 0
    gradients: int = 0
    zero_gradients: int = 0
    nan_gradients: int = 0
    seconds: float = 0.0
    excess: float = 0.0
    evolution: Evolution | None = None

    @property
    def sha256(self) -> str:
        """Hash of the texels; empty if there are none."""
        return "" if self.texels is None else hashlib.sha256(self.texels.contiguous().numpy().tobytes()).hexdigest()

    def written(self, made_by: str) -> bytes:
        """The content of the patch file: texels, cost and, if the attack reported it, the history of the crafting.

        Args:
            made_by: canonical JSON of everything that determines the patch.
        """
        measured = {name: repr(getattr(self, name)) for name in MEASURED}
        tensors = {} if self.texels is None else {"patch": self.texels.contiguous()}
        return save(tensors | _tensors(self.evolution), {"made_by": made_by, "sha256": self.sha256} | measured)

    @classmethod
    def read(cls, content: bytes) -> Patch:
        """The patch from the content of its file.

        Raises:
            UserError: if it cannot be read, or its hash does not match.
        """
        try:
            size = int.from_bytes(content[:8], "little")
            header = bounded.parsed(content[8 : 8 + size])["__metadata__"]
            tensors = load(content)
            patch = cls(
                texels=tensors.get("patch"),
                queries=int(header["queries"]),
                gradients=int(header["gradients"]),
                zero_gradients=int(header.get("zero_gradients", 0)),
                nan_gradients=int(header.get("nan_gradients", 0)),
                seconds=float(header["seconds"]),
                excess=float(header["excess"]),
                evolution=_evolution(tensors),
            )
        except (SafetensorError, KeyError, TypeError, ValueError):
            raise UserError("truncated or foreign") from None
        if patch.sha256 != header.get("sha256"):
            raise UserError("changed since it was written")
        return patch


def written_together(patches: Sequence[Patch], made_by: str) -> bytes:
    """The content of the file of several patches, one for each site: the file of each, as bytes.

    Args:
        patches: in the order of their sites.
        made_by: as in `Patch.written`.
    """
    files = {f"{SITE}{number}": patch.written(made_by) for number, patch in enumerate(patches)}
    tensors = {name: torch.frombuffer(bytearray(content), dtype=torch.uint8) for name, content in files.items()}
    return save(tensors, {"made_by": made_by})


def read_all(content: bytes) -> list[Patch]:
    """The patches of a file: one, or one for each site.

    Raises:
        UserError: if it cannot be read, or a hash does not match.
    """
    try:
        tensors = load(content)
        files = [
            tensors[f"{SITE}{number}"].numpy().tobytes() for number in range(len(tensors)) if f"{SITE}0" in tensors
        ]
    except (SafetensorError, KeyError, ValueError):
        raise UserError("truncated or foreign") from None
    return [Patch.read(each) for each in files or [content]]


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
