"""A patch attack's only access to the detector: a face of the run's enforcer (`cavbench.detection.enforcer`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from cavbench.core.contracts import Access
from cavbench.detection.detector import Predictions, label_of
from cavbench.detection.patch import MOMENTS, Evolution
from cavbench.detection.threat import PatchThreat
from cavbench.errors import UserError


class Door(Protocol):
    """How an oracle reaches the run: queries are counted and answered behind it."""

    @property
    def spent(self) -> int:
        """Number of queries so far."""

    def ask(self, pictures: Tensor, access: Access) -> Predictions:
        """The detector's predictions."""

    def aggregate(self, scores: Tensor) -> Tensor:
        """`Detector.aggregate`."""


class PatchOracle:
    """The only access to the (defended) detector while a patch is crafted. One image is one query.

    It refuses access above the declared level, and queries above the budget. The run keeps its own counters and threat model:
    nothing that is changed on this object changes what the attack may do or what is recorded.

    Args:
        door: answers the queries.
        threat: the threat model.
        generator: the attack's random generator.
        label: the class to hide.
        stride: height and width of an image must be multiples of it.
        names: names of the detector's classes, by label.
    """

    def __init__(
        self,
        door: Door,
        threat: PatchThreat,
        generator: torch.Generator,
        *,
        label: int,
        stride: int,
        names: Sequence[str],
    ) -> None:
        self._door, self.names = door, tuple(names)
        self.threat, self.generator, self.label, self.stride = threat, generator, label, stride
        self._reports, self._every = 0, 1
        self._moments: list[tuple[int, Tensor, dict[str, float]]] = []

    def index(self, name: str) -> int:
        """The label of a class.

        Raises:
            UserError: if the detector does not have this class.
        """
        return label_of(name, self.names)

    @property
    def spent(self) -> int:
        """Number of queries so far."""
        return self._door.spent

    @property
    def remaining(self) -> int:
        """Number of queries left."""
        return self.threat.queries - self.spent

    def predict(self, pictures: Tensor) -> Predictions:
        """The detector's predictions on images [N, 3, H, W] sRGB in [0, 1], without a graph; needs access `scores`."""
        return self._door.ask(pictures, "scores")

    def differentiable(self, pictures: Tensor) -> Predictions:
        """The detector's predictions on images [N, 3, H, W], with the graph back to the pixels; needs access `gradients`."""
        return self._door.ask(pictures, "gradients")

    def aggregate(self, scores: Tensor) -> Tensor:
        """[..., F] what the detector reports of a sign with the scores [..., F] in the frames of an approach, in driving order.

        The scores themselves for a detector without a memory. It costs no query, for it shows no image; needs access `scores`.
        """
        return self._door.aggregate(scores)

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
