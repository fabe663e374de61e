"""A patch attack's access to the detector: the oracle that it is given, and the run's side, which enforces and counts.

`PatchEnforcer` has the detector, the budget and the counters. `PatchOracle` has one method for each kind of query: it asks the
detector in the detector's turn (`PatchEnforcer.asked`), which pays first.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from typing import NoReturn

import torch
from torch import Tensor

from cavbench.core.contracts import Access, QueryBudgetError, permit
from cavbench.detection.detector import STOP_SIGN, Detector, Predictions, label_of
from cavbench.detection.half import Precision, computing_in, in_full
from cavbench.detection.reports import Reports
from cavbench.detection.threat import PatchThreat
from cavbench.isolation.modes import Modes
from cavbench.isolation.streams import Stream
from cavbench.isolation.watch import TamperError, Watch


@dataclass(eq=False, repr=False, kw_only=True, slots=True)
class PatchOracle:
    """The only access to the (defended) detector while a patch is crafted. One image is one query.

    It refuses access above the declared level, and queries above the budget. The run keeps its own counters and threat model:
    nothing that is changed on this object changes what the attack may do or what is recorded.
    """

    _enforcer: PatchEnforcer
    threat: PatchThreat
    """The threat model."""
    generator: torch.Generator
    """The attack's random generator."""
    label: int
    """The class to hide."""
    stride: int
    """Height and width of an image must be multiples of it."""
    names: tuple[str, ...]
    """Names of the detector's classes, by label."""
    reports: Reports
    """What was reported."""

    def __reduce__(self) -> NoReturn:
        # `copy.copy`, `copy.deepcopy` and `pickle` ask here. A deep copy would ask a copy of the detector, uncounted.
        raise TypeError("an oracle cannot be copied")

    def index(self, name: str) -> int:
        """The label of a class.

        Raises:
            UserError: if the detector does not have this class.
        """
        return label_of(name, self.names)

    @property
    def spent(self) -> int:
        """Number of queries so far."""
        return self._enforcer.spent

    @property
    def remaining(self) -> int:
        """Number of queries left."""
        return self.threat.queries - self.spent

    def predict(self, pictures: Tensor) -> Predictions:
        """The detector's predictions on images [N, 3, H, W] sRGB in [0, 1], without a graph; needs access `scores`."""
        with self._enforcer.asked("scores", len(pictures)) as detector, torch.no_grad():
            # The detector gets a copy: one that writes to its input would change the attack's images.
            return detector(pictures.clone())

    def differentiable(self, pictures: Tensor, precision: Precision = "float32") -> Predictions:
        """The detector's predictions on images [N, 3, H, W], with the graph back to the pixels; needs access `gradients`.

        Args:
            pictures: the images.
            precision: of the convolutions and products of matrices; patches are scored in float32 always.
        """
        with self._enforcer.asked("gradients", len(pictures)) as detector, computing_in(precision, detector):
            asked = pictures.clone()
            if asked.requires_grad:
                asked.register_hook(self._enforcer.cleaned)
            found = detector(asked)
        return found if precision == "float32" else in_full(found)

    def aggregate(self, scores: Tensor) -> Tensor:
        """[..., F] what the detector reports of a sign with the scores [..., F] in the frames of an approach, in driving order.

        The scores themselves for a detector without a memory. It costs no query, for it shows no image; needs access `scores`.
        """
        with self._enforcer.asked("scores", 0) as detector:
            return detector.aggregate(scores)

    def report(self, patch: Tensor, **losses: Tensor | float) -> None:
        """Report an intermediate patch for recordings, once per crafting step: `oracle.report(patch, found=loss)`.

        Optional; costs no query and does not change the result. A few evenly spaced steps are kept.

        Args:
            patch: [3, P, P] as `PatchAttack.craft` returns it; the size must not change.
            losses: losses of this patch; the attack chooses the names.

        Raises:
            UserError: if the shape is wrong or has changed.
        """
        self.reports.add(patch, losses)


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
        reports: where reported patches go; by default the oracle's own.
    """

    def __init__(
        self,
        detector: Detector,
        threat: PatchThreat,
        access: Access,
        generator: torch.Generator,
        watch: Watch | None = None,
        stream: Stream | None = None,
        reports: Reports | None = None,
    ) -> None:
        self.detector, self.access = detector, access
        self.threat = deepcopy(threat)
        self.watch, self.stream, self._modes = watch, stream, Modes()
        self.spent = self.backwards = self.zeros = self.nans = self._evaluated = 0
        self.reports = reports or Reports(self.threat)
        self.oracle = PatchOracle(
            _enforcer=self,
            # What the attack is given is its own: what it does to it changes nothing for the run.
            threat=deepcopy(threat),
            generator=generator,
            label=detector.index(STOP_SIGN),
            stride=detector.stride,
            names=tuple(detector.names),
            reports=self.reports,
        )

    @contextmanager
    def turn(self) -> Iterator[None]:
        """Let the attack craft: with its own random numbers, and with an eye on the detector.

        Raises:
            TamperError: if it reached the detector past the oracle, changed the counts, or left a mode of torch on.
        """
        self._switch(True)
        try:
            with self._modes.around("attack"):
                yield
        finally:
            self._switch(False)
        if self.spent != self._evaluated:
            raise TamperError("the attack changed the count of its queries", "attack")
        if self.watch and self.watch.strays:
            raise TamperError("the attack evaluated the detector past the oracle", "attack")

    @contextmanager
    def asked(self, access: Access, images: int) -> Iterator[Detector]:
        """The detector for so many queries, which are counted first: its calls are no strays, and it draws from its own stream.

        Raises:
            UserError: if the attack declares less access.
            QueryBudgetError: if too few queries are left.
        """
        permit(access, self.access)
        wanted = self.spent + images
        if wanted > self.threat.queries:
            raise QueryBudgetError(
                f"the attack asked about {wanted} images, the threat model allows {self.threat.queries}"
            )
        self.spent = wanted
        self._evaluated += images
        away = self.watch is not None and self.watch.away
        if away:
            self._switch(False)
        try:
            with self._modes.for_victim():
                yield self.detector
                self._modes.settle("defense")
        finally:
            if away:
                self._switch(True)

    def _switch(self, foreign: bool) -> None:
        if self.watch:
            self.watch.away = foreign
        if self.stream:
            self.stream.swap()

    def cleaned(self, gradient: Tensor) -> Tensor:
        """The gradient [N, 3, H, W], counted, with 0 for each NaN or infinite entry: one such pixel would spoil every texel."""
        if not bool(gradient.sum().isfinite()):
            lost = ~gradient.isfinite()
            gradient = gradient.masked_fill(lost, 0.0)
            self.nans += int(lost.flatten(1).any(1).sum())
        self.backwards += len(gradient)
        self.zeros += int((gradient == 0).flatten(1).all(1).sum())
        return gradient
