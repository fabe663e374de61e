"""A patch that is crafted against other detectors: the victim is never asked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import ClassVar

import torch
from torch import Tensor

from cavbench.attacks.detection.eot import EOT, Loss
from cavbench.attacks.detection.shake_drop import shake
from cavbench.core.contracts import Access, Facts, Progress
from cavbench.core.pair import choose
from cavbench.core.ranges import Count, NotNegative, Share
from cavbench.detection import STOP_SIGN, Detector, DetectorVictim, PatchOracle, Predictions, Scenes
from cavbench.detection.access import PatchEnforcer
from cavbench.errors import UserError
from cavbench.scenarios.axes import Axes

BETWEEN = "+"
"""Between the names of surrogates."""


@dataclass(frozen=True, kw_only=True)
class Transfer(EOT):
    """A universal patch against several detectors (as T-SEA, Huang et al. 2023, arXiv 2211.09773), shown to one it never met.

    `eot` on surrogates: detectors of the zoo, each as it is without a defence. They take turns, a step each, so that the loss is
    in the mean that of all of them. The victim answers no question, so this is the attack of somebody who knows nothing about it.
    A run refuses a victim that is among the surrogates: on it the attack would be a white box. Two tricks of T-SEA keep the patch
    from relying on one small part of itself (`cutout`), and on one network (`shake_drop`).

    Args:
        surrogates: names of detectors, joined by "+" (default yolov5+fcos).
        steps: optimiser steps of all surrogates together, at least 1 (default 600).
        loss: what is minimised: the mean of the score, or of its log-odds (default log_odds).
        tv: weight of the total variation (default 0.05).
        window: side in pixels of the square window around the sign (default 160).
        cutout: probability that a random square of the patch is grey in a view (default 0.9, as in T-SEA).
        shake_drop: probability that a residual branch of a surrogate is scaled at random in a step (default 0; T-SEA: 0.5).

    The other parameters are those of `eot`, without `target`: surrogates tell of the stop sign alone.

    Queries: none. The surrogates are asked about at most as many images as the threat model allows for the victim.

    Example:
        >>> from cavbench.attacks.detection.transfer import Transfer
        >>> of_one = Transfer(surrogates="fcos")
    """

    access: ClassVar[Access] = "oblivious"

    surrogates: str = "yolov5+fcos"
    steps: Count = 600
    loss: Loss = "log_odds"
    tv: NotNegative = 0.05
    window: Count = 160
    cutout: Share = 0.9
    shake_drop: Share = 0.0

    def craft(self, oracle: PatchOracle, scenes: Scenes, progress: Progress) -> Tensor:
        detectors = self._detectors()
        if self.shake_drop and not sum(shake(each, self.shake_drop, oracle.generator) for each in detectors):
            raise UserError(f"attack.shake_drop={self.shake_drop:g}: {self.surrogates} has no residual branches")
        # What `eot` asks instead of the victim; intermediate patches are reported as those of the victim's oracle.
        surrogates = PatchEnforcer(
            Turns(detectors), oracle.threat, "gradients", oracle.generator, reports=oracle.reports
        )
        return super().craft(surrogates.oracle, scenes, progress)

    def misfit(self, victim: DetectorVictim) -> str:
        """A patch against the victim itself would not be one of somebody who knows nothing about it."""
        if any(type(victim) is type(surrogate) for surrogate in self._victims()):
            return f"which attack.surrogates={self.surrogates} names: craft the patch against other detectors"
        return ""

    def _victims(self) -> list[DetectorVictim]:
        victims = [choose("victim", name).component for name in self.surrogates.split(BETWEEN)]
        for victim in victims:
            if not isinstance(victim, DetectorVictim):
                raise UserError(f"attack.surrogates={self.surrogates}: {type(victim).__name__} is no detector")
        return victims

    def _detectors(self) -> list[Detector]:
        # A network draws random weights before it gets those of its file. The patch shall not depend on these draws.
        with torch.random.fork_rng(devices=[]):
            return [victim.load(0, Facts(axes=Axes(()))) for victim in self._victims()]


class Turns(Detector):
    """A detector of the stop sign alone, which hands each batch of images to the next of some detectors.

    Args:
        detectors: they take turns.
    """

    names = (STOP_SIGN,)

    def __init__(self, detectors: Sequence[Detector]) -> None:
        super().__init__()
        self.stride = max(detector.stride for detector in detectors)
        self._turns = cycle(detectors)

    def predict(self, pictures: Tensor) -> Predictions:
        detector = next(self._turns)
        predictions = detector(pictures)
        of_sign = predictions.scores_of(detector.index(STOP_SIGN))
        return Predictions(predictions.boxes, of_sign, torch.ones_like(of_sign)[..., None])
