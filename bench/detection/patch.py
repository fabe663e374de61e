"""A crafted patch, how it came about and what it cost, and the safetensors file that it is kept in."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass

from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from bench.errors import UserError

MOMENTS = 20
"""Most that are kept of how a patch came about."""
MEASURED = ("queries", "gradients", "zero_gradients", "seconds", "excess")
LOSS = "loss."


@dataclass(frozen=True)
class Evolution:
    """How a patch came about: K moments of its crafting, at most `MOMENTS` and evenly apart.

    Args:
        steps: int64 [K], counted from 0.
        texels: uint8 [K, 3, P, P] sRGB.
        losses: float32 [K] by name; NaN where the attack did not say.
    """

    steps: Tensor
    texels: Tensor
    losses: Mapping[str, Tensor]


@dataclass(frozen=True)
class Patch:
    """A crafted patch and what it cost.

    Args:
        texels: float32 [3, P, P] sRGB in [0, 1]; None leaves the sign alone.
        queries: pictures the detector was asked about.
        gradients: pictures whose gradient was taken.
        zero_gradients: those of them whose gradient was 0 everywhere.
        seconds: wall time.
        excess: how far outside [0, 1] the attack's own texels were.
        evolution: what the attack reported while it crafted; None where it reported nothing.
    """

    texels: Tensor | None
    queries: int = 0
    gradients: int = 0
    zero_gradients: int = 0
    seconds: float = 0.0
    excess: float = 0.0
    evolution: Evolution | None = None

    @property
    def sha256(self) -> str:
        """Of the texels; empty where there are none."""
        return "" if self.texels is None else hashlib.sha256(self.texels.contiguous().numpy().tobytes()).hexdigest()

    def written(self, made_by: str) -> bytes:
        """The content of the file it is kept in: the patch, what it cost, and how it came about, if its attack reported that.

        Args:
            made_by: canonical JSON of what decides it.
        """
        measured = {name: repr(getattr(self, name)) for name in MEASURED}
        tensors = {} if self.texels is None else {"patch": self.texels.contiguous()}
        return save(tensors | _tensors(self.evolution), {"made_by": made_by, "sha256": self.sha256} | measured)

    @classmethod
    def read(cls, content: bytes) -> Patch:
        """The patch in the content of a file.

        Raises:
            UserError: if it cannot be read, or is not what was written.
        """
        try:
            size = int.from_bytes(content[:8], "little")
            said = json.loads(content[8 : 8 + size])["__metadata__"]
            tensors = load(content)
            patch = cls(
                texels=tensors.get("patch"),
                queries=int(said["queries"]),
                gradients=int(said["gradients"]),
                zero_gradients=int(said.get("zero_gradients", 0)),
                seconds=float(said["seconds"]),
                excess=float(said["excess"]),
                evolution=_evolution(tensors),
            )
        except (SafetensorError, KeyError, TypeError, ValueError):
            raise UserError("truncated or foreign") from None
        if patch.sha256 != said.get("sha256"):
            raise UserError("changed since it was written")
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
