"""The intermediate patches that an attack reports while it crafts, for recordings."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from cavbench.detection.patch import MOMENTS, Evolution
from cavbench.detection.threat import PatchThreat
from cavbench.errors import UserError


class Reports:
    """Keeps at most `MOMENTS` evenly spaced ones of the patches that are added.

    Args:
        threat: the threat model; patches are projected onto its set.
    """

    def __init__(self, threat: PatchThreat) -> None:
        self._threat = threat
        self._added, self._every = 0, 1
        self._moments: list[tuple[int, Tensor, dict[str, float]]] = []

    def add(self, patch: Tensor, losses: Mapping[str, Tensor | float]) -> None:
        """Add a patch [3, P, P] and its losses by name.

        Raises:
            UserError: if the shape is wrong or has changed.
        """
        if self._added % self._every == 0:
            texels = (255 * self._threat.project(patch)[0]).round().to(torch.uint8)
            if self._moments and texels.shape != self._moments[0][1].shape:
                raise UserError(
                    f"the attack reported patches of {self._moments[0][1].shape[1]} and {texels.shape[1]} texels"
                )
            values = {name: float(torch.as_tensor(value).detach()) for name, value in losses.items()}
            self._moments.append((self._added, texels, values))
        if len(self._moments) > MOMENTS:
            self._moments, self._every = self._moments[::2], 2 * self._every
        self._added += 1

    @property
    def evolution(self) -> Evolution | None:
        """The patches and losses; None if nothing was added."""
        if not self._moments:
            return None
        steps, texels, losses = zip(*self._moments, strict=True)
        names = dict.fromkeys(name for values in losses for name in values)
        return Evolution(
            steps=torch.tensor(steps),
            texels=torch.stack(texels),
            losses={name: torch.tensor([values.get(name, torch.nan) for values in losses]) for name in names},
        )
