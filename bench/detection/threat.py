"""What a patch attacker may know and change, and the oracle that enforces it."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from bench.detection.contracts import STOP_SIGN, Detector, Predictions
from bench.errors import UserError
from bench.plugins.contracts import Access, QueryBudgetError, ThreatModel, permit

SIDES = range(8, 513)
"""Texels a patch may be wide and high."""
GREY = 0.5
"""What a texel that is no number becomes."""
MOMENTS = 20
"""Most that are kept of how a patch came about."""


def check_texels(attack: str, texels: int) -> None:
    """Raise ValueError unless a patch of an attack may be `texels` wide and high."""
    if texels not in SIDES:
        raise ValueError(f"{attack}.texels must be between {SIDES[0]} and {SIDES[-1]}, got {texels}")


@dataclass(frozen=True, kw_only=True)
class PatchThreat(ThreatModel):
    """The threat model of the detection track.

    Args:
        norm: `patch`: any texels on a square in the middle of the sign, nothing elsewhere.
        budget: side of the square as a share of the sign's, in (0, 1]; 0 with no queries is nobody's.
        queries: most pictures the detector is asked about while a patch is crafted, all together.
    """

    norm: Literal["patch"] = "patch"
    budget: float = 0.5
    queries: int = 20_000

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.norm != "patch":
            raise ValueError(f"threat.norm must be patch, got {self.norm!r}")
        if not 0 < self.budget <= 1 and (self.budget, self.queries) != (0, 0):
            raise ValueError(f"threat.budget must be in (0, 1], a share of the sign's side, got {self.budget}")

    def project(self, texels: Tensor) -> tuple[Tensor, float]:
        """The patch that is shown, float32, and how far the texels given were outside [0, 1].

        Args:
            texels: [3, P, P]; what is out of range is clipped, what is no number becomes grey.

        Raises:
            UserError: if the shape is another.
        """
        if (
            texels.ndim != 3
            or texels.shape[0] != 3
            or texels.shape[1] != texels.shape[2]
            or texels.shape[1] not in SIDES
        ):
            wanted = f"[3, P, P] with P from {SIDES[0]} to {SIDES[-1]}"
            raise UserError(f"a patch must be {wanted}, the attack made one of {list(texels.shape)}")
        given = texels.detach().to("cpu", torch.float32)
        given = torch.where(given.isnan(), GREY, given)
        patch = torch.where(given.isinf(), GREY, given.clamp(0, 1))
        return patch, float((given - patch).abs().where(given.isfinite(), 0).max())


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


class VisionOracle:
    """The only door to the (defended) detector while a patch is crafted. A picture asked about is a query.

    `spent` counts the pictures asked about, `backwards` those whose gradient was taken, `zeros` those where it was 0 everywhere.

    Args:
        detector: the victim.
        threat: the threat model.
        access: what the attack declared it needs; more than that is refused.
        generator: the run's random generator, for attacks that draw.
    """

    def __init__(self, detector: Detector, threat: PatchThreat, access: Access, generator: torch.Generator) -> None:
        self._detector = detector
        self._access: Access = access
        self.threat = threat
        self.generator = generator
        self.label = detector.index(STOP_SIGN)
        self.stride = detector.stride
        self.spent = self.backwards = self.zeros = 0
        self._reports, self._every = 0, 1
        self._moments: list[tuple[int, Tensor, dict[str, float]]] = []

    @property
    def remaining(self) -> int:
        """Pictures it may still be asked about."""
        return self.threat.queries - self.spent

    @torch.no_grad()
    def predict(self, pictures: Tensor) -> Predictions:
        """What the detector says of pictures [N, 3, H, W] sRGB in [0, 1], without a graph; needs access `scores`."""
        self._spend(len(pictures), "scores")
        return self._detector(pictures)

    def differentiable(self, pictures: Tensor) -> Predictions:
        """What the detector says of pictures [N, 3, H, W], with the graph back to the pixels; needs access `gradients`."""
        self._spend(len(pictures), "gradients")
        asked = pictures.view_as(pictures)
        if asked.requires_grad:
            asked.register_hook(self._came_back)
        return self._detector(asked)

    def report(self, patch: Tensor, **losses: Tensor | float) -> None:
        """Show how far the patch is, for recordings: `oracle.report(patch, found=loss)`, once a step of the crafting.

        Optional, no query, and without effect on the result. A few of the steps are kept, evenly apart.

        Args:
            patch: [3, P, P] as `PatchAttack.craft` returns it, of one size throughout.
            losses: what the patch of this step scores, by names of the attack's choosing.

        Raises:
            UserError: if the shape is another.
        """
        if self._reports % self._every == 0:
            texels = (255 * self.threat.project(patch)[0]).round().to(torch.uint8)
            if self._moments and texels.shape != self._moments[0][1].shape:
                raise UserError(
                    f"the attack reported patches of {self._moments[0][1].shape[1]} and {texels.shape[1]} texels"
                )
            values = {name: float(torch.as_tensor(value).detach()) for name, value in losses.items()}
            self._moments.append((self._reports, texels, values))
        if len(self._moments) > MOMENTS:
            self._moments, self._every = self._moments[::2], 2 * self._every
        self._reports += 1

    @property
    def evolution(self) -> Evolution | None:
        """What was reported; None if nothing was."""
        if not self._moments:
            return None
        steps, texels, losses = zip(*self._moments, strict=True)
        names = dict.fromkeys(name for values in losses for name in values)
        return Evolution(
            steps=torch.tensor(steps),
            texels=torch.stack(texels),
            losses={name: torch.tensor([values.get(name, torch.nan) for values in losses]) for name in names},
        )

    def _came_back(self, gradient: Tensor) -> None:
        self.backwards += len(gradient)
        self.zeros += int((gradient == 0).flatten(1).all(1).sum())

    def _spend(self, pictures: int, access: Access) -> None:
        permit(access, self._access)
        if pictures > self.remaining:
            raise QueryBudgetError(
                f"the attack asked about {self.spent + pictures} pictures, the threat model allows {self.threat.queries}"
            )
        self.spent += pictures
