"""A patch by random search with the detector's scores alone: squares of one colour that make the sign less certain are kept."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
from annotated_types import Interval
from torch import Tensor

from cavbench.attacks.detection.views import Views
from cavbench.core.contracts import Access, Progress
from cavbench.core.ranges import Count
from cavbench.detection import PatchAttack, PatchOracle, Scenes
from cavbench.detection.evidence import log_odds
from cavbench.detection.threat import HIDING, Texels

REPORT_EVERY = 10
"""Steps between two progress reports."""
HALVED = (0.001, 0.005, 0.02, 0.1, 0.2, 0.4, 0.6, 0.8)
"""Shares of the steps after which the squares have half the area (Andriushchenko et al. 2020, section 3.1)."""


@dataclass(frozen=True, kw_only=True)
class SquarePatch(PatchAttack):
    """Square Attack (Andriushchenko et al. 2020, arXiv 1912.00049) on a patch (Croce et al. 2022, Sparse-RS, arXiv 2006.12834).

    Starts from random stripes. Each step paints a square of a random place and colour on the patch, each channel 0 or 1. It is
    kept if that lowers the sign's highest score: the mean of its log-odds over some views of the training places. The views are
    drawn again after some steps, so that the patch does not learn them by heart. It needs scores and no gradients: it attacks
    black boxes, and tells whether a defence only hides its gradients. With norm `print` its colours are made printable.

    Args:
        texels: side of the patch in texels, from 8 to 512 (default 100).
        steps: squares that are tried, at least 1 (default 1000).
        views: images of a step, at least 1 (default 16).
        renew: steps with the same views, at least 1 (default 50).
        area: share of the patch that the first squares cover, above 0 (default 0.3).
        window: side in pixels of the square window around the sign; a multiple of the detector's stride (default 160).
        translation: largest shift of the sign, as a share of the window (default 0.15).

    Queries: views * (steps + steps / renew, rounded up) images.

    Example:
        >>> from cavbench.attacks.detection.square_patch import SquarePatch
        >>> quick = SquarePatch(steps=100)
    """

    access: ClassVar[Access] = "scores"

    texels: Texels = 100
    steps: Count = 1000
    views: Count = 16
    renew: Count = 50
    area: Annotated[float, Interval(gt=0, le=1)] = 0.3
    window: Count = 160
    translation: Annotated[float, Interval(ge=0, lt=1)] = 0.15

    @property
    def forges(self) -> tuple[str, ...]:
        return HIDING

    def craft(self, oracle: PatchOracle, scenes: Scenes, progress: Progress) -> Tensor:
        views = Views(oracle, scenes, window=self.window, translation=self.translation)
        confine = oracle.threat.confine
        patch = confine(self._stripes(oracle.generator))
        least = torch.inf, torch.inf
        for step in range(self.steps):
            fresh = step % self.renew == 0
            if oracle.remaining < self.views * (1 + fresh):
                break
            if fresh:
                views.draw(self.views)
                least = self._losses(oracle, views, patch)
            tried = confine(self._painted(patch, step / self.steps, oracle.generator))
            losses = self._losses(oracle, views, tried)
            if losses < least:
                patch, least = tried, losses
            found = 1 / (1 + math.exp(-least[0]))
            oracle.report(patch, found=found)
            if step % REPORT_EVERY == 0:
                progress(step / self.steps, f"stop sign {found:.2f}")
        return patch

    def _losses(self, oracle: PatchOracle, views: Views, patch: Tensor) -> tuple[float, float]:
        """The mean log-odds of the sign as the detector reports it, and in each view by itself, which decides between equals."""
        highest = views.highest(oracle.predict(views.shown(patch[None])))
        return float(log_odds(views.reported(highest)).mean()), float(log_odds(highest).mean())

    def _stripes(self, generator: torch.Generator) -> Tensor:
        """[3, P, P] vertical stripes of random colours, one texel wide."""
        colours = torch.randint(2, (3, 1, self.texels), generator=generator).float()
        return colours.expand(3, self.texels, self.texels).clone()

    def _painted(self, patch: Tensor, done: float, generator: torch.Generator) -> Tensor:
        """The patch with a square of a random place and colour."""
        area = self.area / 2 ** sum(done >= share for share in HALVED)
        side = max(1, round(self.texels * area**0.5))
        top, left = torch.randint(self.texels - side + 1, (2,), generator=generator).tolist()
        painted = patch.clone()
        painted[:, top : top + side, left : left + side] = torch.randint(2, (3, 1, 1), generator=generator).float()
        return painted
