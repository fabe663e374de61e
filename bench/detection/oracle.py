"""The only door of a patch attack to the detector: it enforces the access level and the query budget."""

from __future__ import annotations

import torch
from torch import Tensor

from bench.detection.detector import STOP_SIGN, Detector, Predictions
from bench.detection.patch import MOMENTS, Evolution
from bench.detection.threat import PatchThreat
from bench.errors import UserError
from bench.plugins.contracts import Access, QueryBudgetError, permit


class PatchOracle:
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
