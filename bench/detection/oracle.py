"""A patch attack's only access to the detector; enforces the access level and the query budget."""

from __future__ import annotations

import torch
from torch import Tensor

from bench.detection.detector import STOP_SIGN, Detector, Predictions
from bench.detection.patch import MOMENTS, Evolution
from bench.detection.threat import PatchThreat
from bench.errors import UserError
from bench.plugins.contracts import Access, QueryBudgetError, permit


class PatchOracle:
    """The only access to the (defended) detector while a patch is crafted. One image is one query.

    `spent` counts the queries, `backwards` the images whose gradient was computed, `zeros` the gradients that were 0 everywhere.

    Args:
        detector: the victim.
        threat: the threat model.
        access: the access level that the attack declares; calls above it are refused.
        generator: the run's random generator, for randomised attacks.
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
        """Number of queries left."""
        return self.threat.queries - self.spent

    @torch.no_grad()
    def predict(self, pictures: Tensor) -> Predictions:
        """The detector's predictions on images [N, 3, H, W] sRGB in [0, 1], without a graph; needs access `scores`."""
        self._spend(len(pictures), "scores")
        return self._detector(pictures)

    def differentiable(self, pictures: Tensor) -> Predictions:
        """The detector's predictions on images [N, 3, H, W], with the graph back to the pixels; needs access `gradients`."""
        self._spend(len(pictures), "gradients")
        asked = pictures.view_as(pictures)
        if asked.requires_grad:
            asked.register_hook(self._came_back)
        return self._detector(asked)

    def report(self, patch: Tensor, **losses: Tensor | float) -> None:
        """Report an intermediate patch for recordings, once per crafting step: `oracle.report(patch, found=loss)`.

        Optional; costs no query and does not change the result. At most `MOMENTS` evenly spaced steps are kept.

        Args:
            patch: [3, P, P] as `PatchAttack.craft` returns it; the size must not change.
            losses: losses of this patch; the attack chooses the names.

        Raises:
            UserError: if the shape is wrong or has changed.
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
        """The reported patches and losses; None if nothing was reported."""
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
                f"the attack asked about {self.spent + pictures} images, the threat model allows {self.threat.queries}"
            )
        self.spent += pictures
