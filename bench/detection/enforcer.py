"""The run's side of a patch attack: the detector, the threat model and the counters, which no attack is given."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy

import torch
from torch import Tensor

from cavbench.core.contracts import Access, QueryBudgetError, permit
from cavbench.detection.detector import STOP_SIGN, Detector, Predictions
from cavbench.detection.oracle import PatchOracle
from cavbench.detection.threat import PatchThreat
from cavbench.isolation.streams import Stream
from cavbench.isolation.watch import TamperError, Watch


class PatchEnforcer:
    """Enforces the access level and the query budget of a patch attack; `oracle` is what the attack is given.

    `spent` counts the queries, `backwards` the images whose gradient was computed, `zeros` the gradients that were 0 everywhere,
    `nans` those with a NaN or infinite entry.

    Args:
        detector: the victim.
        threat: the threat model.
        access: the access level that the attack declares; calls above it are refused.
        generator: the attack's random generator.
        watch: a watch on the detector; None in trainings and checks.
        stream: random numbers of the attack; None for those of the process.
    """

    def __init__(
        self,
        detector: Detector,
        threat: PatchThreat,
        access: Access,
        generator: torch.Generator,
        watch: Watch | None = None,
        stream: Stream | None = None,
    ) -> None:
        self.detector, self.access = detector, access
        self.threat = deepcopy(threat)
        self.watch, self.stream = watch, stream
        self.spent = self.backwards = self.zeros = self.nans = self._evaluated = 0
        # What the attack is given is its own: what it does to it changes nothing for the run.
        self.oracle = PatchOracle(
            self,
            deepcopy(threat),
            generator,
            label=detector.index(STOP_SIGN),
            stride=detector.stride,
            names=detector.names,
        )

    @contextmanager
    def turn(self) -> Iterator[None]:
        """Let the attack craft: with its own random numbers, and with an eye on the detector.

        Raises:
            TamperError: if it reached the detector past the oracle, or changed the counts.
        """
        self._switch(True)
        try:
            yield
        finally:
            self._switch(False)
        if self.spent != self._evaluated:
            raise TamperError("the attack changed the count of its queries", "attack")
        if self.watch and self.watch.strays:
            raise TamperError("the attack evaluated the detector past the oracle", "attack")

    def _switch(self, foreign: bool) -> None:
        if self.watch:
            self.watch.away = foreign
        if self.stream:
            self.stream.swap()

    def ask(self, pictures: Tensor, access: Access) -> Predictions:
        """The detector's predictions on images [N, 3, H, W]; counted first.

        Raises:
            UserError: if the attack declares less access.
            QueryBudgetError: if too few queries are left.
        """
        permit(access, self.access)
        if self.spent + len(pictures) > self.threat.queries:
            raise QueryBudgetError(
                f"the attack asked about {self.spent + len(pictures)} images, the threat model allows {self.threat.queries}"
            )
        self.spent += len(pictures)
        with self._detectors_turn():
            self._evaluated += len(pictures)
            if access == "scores":
                with torch.no_grad():
                    # The detector gets a copy: one that writes to its input would change the attack's images.
                    return self.detector(pictures.clone())
            asked = pictures.clone()
            if asked.requires_grad:
                asked.register_hook(self._came_back)
            return self.detector(asked)

    def aggregate(self, scores: Tensor) -> Tensor:
        """What the detector reports of a sign over the frames of an approach (`Detector.aggregate`).

        Raises:
            UserError: if the attack declares less access.
        """
        permit("scores", self.access)
        with self._detectors_turn():
            return self.detector.aggregate(scores)

    @contextmanager
    def _detectors_turn(self) -> Iterator[None]:
        """While the detector computes, its calls are no strays and it draws from its own stream."""
        away = self.watch is not None and self.watch.away
        if away:
            self._switch(False)
        try:
            yield
        finally:
            if away:
                self._switch(True)

    def _came_back(self, gradient: Tensor) -> Tensor:
        """The gradient [N, 3, H, W], with 0 for each entry that is NaN or infinite: one such pixel would spoil every texel."""
        if not bool(gradient.sum().isfinite()):
            lost = ~gradient.isfinite()
            gradient = gradient.masked_fill(lost, 0.0)
            self.nans += int(lost.flatten(1).any(1).sum())
        self.backwards += len(gradient)
        self.zeros += int((gradient == 0).flatten(1).all(1).sum())
        return gradient
