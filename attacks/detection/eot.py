"""Expectation over transformation (EOT): a patch that hides a sign from a detector under random views and transformations."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from operator import itemgetter
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import torch
from annotated_types import Interval
from torch import Tensor

from cavbench.attacks.detection.schedule import Schedule
from cavbench.attacks.detection.views import Views
from cavbench.core.contracts import Access, Progress
from cavbench.core.ranges import Count, NotNegative, Positive, Share
from cavbench.detection import PatchAttack, PatchOracle, Predictions, Scenes
from cavbench.detection.boxes import overlap
from cavbench.detection.evidence import log_odds
from cavbench.detection.half import Precision
from cavbench.detection.printing import non_printability
from cavbench.detection.threat import HIDING, Texels

if TYPE_CHECKING:
    from cavbench.attacks.detection.transformations import Transformations

Loss = Literal["probability", "log_odds"]

REPORT_EVERY = 5
"""Steps between two progress reports."""
CUT = 0.4
"""Side of the square that `cutout` greys, as a share of the patch's side."""
JUDGED = 0.2
"""Share of the steps, the last ones, whose mean loss says which start is the best."""
COUNTED, SOFTNESS = 0.3, 0.05
"""The overlap (IoU) from which on a box counts for the score of a frame, and the width of the soft threshold in the loss."""


@dataclass(frozen=True, kw_only=True)
class EOT(PatchAttack):
    """Expectation over transformation (Athalye et al. 2018; thesis, Algorithm 3, Eq. 3.1 and 3.2).

    Minimises the highest score (objectness times class probability) of a stop sign in a window around the sign, averaged over
    views of the training places and random transformations of the image, plus `tv` times the patch's total variation. Uses Adam
    with a cosine schedule and clamps the patch to [0, 1]. White box: access `gradients`. 0 disables a transformation.

    Where a detector is sure, the gradient of a probability vanishes; the log-odds log(p / (1 - p)) keep it (as the margin loss of
    Carlini and Wagner 2017 does). Of several restarts, the patch with the lowest loss in the last steps is kept.

    Against a detector with a memory, the views of a step are taken as the frames of one approach, farthest first, and the loss is
    that of the scores which it reports (`Detector.aggregate`): all frames are attacked together.

    With norm `print` each step ends with printable texels, so the patch that is optimised is the one that is scored.

    Args:
        target: class that the detector shall see instead, such as "traffic sign": the loss of its highest score on the sign is
            subtracted. Empty: the sign shall only vanish (default).
        texels: side of the patch in texels, from 8 to 512 (default 100, as in the thesis, which also uses 32 and 64).
        steps: optimiser steps of each start, at least 1 (default 150).
        restarts: number of random starts, at least 1 (default 1).
        loss: what is minimised: the mean of the score, or of its log-odds (default probability).
        batch: views per step, at least 1 (default 8).
        learning_rate: learning rate of Adam, above 0 (default 0.05).
        tv: weight of the total variation: mean absolute difference of neighbouring texels, in both directions (default 0.1).
        nps: weight of the non-printability score: mean distance to the nearest of thirty printable colours (default 0).
        window: side in pixels of the square window around the sign; a multiple of the detector's stride (default 320).
        rotation: largest rotation, in degrees (default 8).
        scale: largest change of size, as a share (default 0.3).
        translation: largest shift, as a share of the window; with 0 the sign is in the middle (default 0.15).
        perspective: distortion of the window's corners, as a share of half its side (default 0.15).
        brightness, contrast, saturation: largest change, as a share (default 0.2 each).
        hue: largest rotation of the hue, as a share of the full circle, up to 0.5 (default 0.05).
        noise: standard deviation of Gaussian noise on the sRGB scale (default 0.02).
        cutout: probability that a random square of the patch is grey in a view, so that no part of the patch is needed alone
            (T-SEA, Huang et al. 2023, arXiv 2211.09773) (default 0).
        moves: whether boxes may also be moved away: a score counts as far as its box overlaps the sign's by `COUNTED` and more,
            which is what the score of a frame counts (default False).
        patience: a start ends after so many steps without a lower loss, and the learning rate halves after half as many;
            `steps` is then the most. 0: all steps, with a cosine schedule (default 0).
        precision: of the detector's passes while the patch is crafted; with `bfloat16` they take half the time on processors
            that compute in it. The patch is scored in float32 (default float32).

    Queries: at most restarts * steps * batch images.

    Example:
        >>> from cavbench.attacks.detection.eot import EOT
        >>> without_colour = EOT(brightness=0, contrast=0, saturation=0, hue=0)
    """

    access: ClassVar[Access] = "gradients"
    towards: ClassVar[float] = 1.0
    """1 where the score of the sign shall be low, -1 where it shall be high."""

    target: str = ""
    texels: Texels = 100
    steps: Count = 150
    restarts: Count = 1
    loss: Loss = "probability"
    batch: Count = 8
    learning_rate: Positive = 0.05
    tv: NotNegative = 0.1
    nps: NotNegative = 0.0
    window: Count = 320
    rotation: Annotated[float, Interval(ge=0, le=180)] = 8.0
    scale: Annotated[float, Interval(ge=0, lt=1)] = 0.3
    translation: Annotated[float, Interval(ge=0, lt=1)] = 0.15
    perspective: Annotated[float, Interval(ge=0, lt=1)] = 0.15
    brightness: Annotated[float, Interval(ge=0, lt=1)] = 0.2
    contrast: Annotated[float, Interval(ge=0, lt=1)] = 0.2
    saturation: Annotated[float, Interval(ge=0, lt=1)] = 0.2
    hue: Annotated[float, Interval(ge=0, le=0.5)] = 0.05
    noise: NotNegative = 0.02
    cutout: Share = 0.0
    moves: bool = False
    patience: Annotated[int, Interval(ge=0)] = 0
    precision: Precision = "float32"

    def craft(self, oracle: PatchOracle, scenes: Scenes, progress: Progress) -> Tensor:
        found = [
            self._optimised(oracle, scenes, partial(self._report, progress, start)) for start in range(self.restarts)
        ]
        patch, _ = min(found, key=itemgetter(1))
        return patch

    def _report(self, progress: Progress, start: int, share: float, text: str) -> None:
        """Report the share of one start that is done."""
        progress((start + share) / self.restarts, text)

    def _optimised(self, oracle: PatchOracle, scenes: Scenes, progress: Progress) -> tuple[Tensor, float]:
        """A patch [3, P, P] from a random start, and its mean loss in the last steps; infinite if the queries ended before."""
        from cavbench.attacks.detection.transformations import Transformations

        patch = torch.rand(1, 3, self.texels, self.texels, generator=oracle.generator).requires_grad_(True)
        adam = torch.optim.Adam([patch], lr=self.learning_rate)
        schedule = Schedule(adam, self.steps, self.patience)
        views = Views(oracle, scenes, window=self.window, translation=self.translation)
        transform = Transformations(
            rotation=self.rotation,
            scale=self.scale,
            perspective=self.perspective,
            brightness=self.brightness,
            contrast=self.contrast,
            saturation=self.saturation,
            hue=self.hue,
            noise=self.noise,
        )
        losses, ended = [], False
        for step in range(min(self.steps, oracle.remaining // self.batch)):
            views.draw(self.batch)
            shown = cut_out(patch, self.batch, self.cutout, oracle.generator) if self.cutout else patch
            predictions = oracle.differentiable(transform(views.shown(shown), views.reach), self.precision)
            scores = views.reported(self._scores(oracle, views, transform, predictions))
            found, variation = scores.mean(), total_variation(patch)
            oracle.report(patch[0], found=found, total_variation=variation)
            loss = self.towards * self._loss(scores) + self.tv * variation
            if self.target:
                places = transform.carried(views.boxes)
                loss = loss - self._loss(seen_at(places, predictions, oracle.index(self.target)))
            if self.nps:
                loss = loss + self.nps * non_printability(patch)
            adam.zero_grad()
            loss.backward()
            adam.step()
            losses.append(loss.item())
            ended = schedule.step(losses[-1])
            with torch.no_grad():
                patch.copy_(oracle.threat.confine(patch))
            if step % REPORT_EVERY == 0:
                progress(step / self.steps, f"stop sign {found.item():.2f}")
            if ended:
                break
        last = losses[-max(1, round(JUDGED * len(losses))) :]
        mean = sum(last) / len(last) if len(losses) == self.steps or ended else torch.inf
        # A start whose loss is not a number is never the best one.
        return patch.detach()[0], torch.inf if mean != mean else mean

    @property
    def forges(self) -> tuple[str, ...]:
        return HIDING

    def _scores(
        self, oracle: PatchOracle, views: Views, transform: Transformations, predictions: Predictions
    ) -> Tensor:
        """[N] what is attacked in each view: the highest score of a stop sign."""
        if not self.moves:
            return views.highest(predictions)
        sign = transform.carried(views.boxes).unsqueeze(1)
        on_sign = ((overlap(predictions.boxes, sign) - COUNTED) / SOFTNESS).sigmoid()
        return (predictions.scores_of(oracle.label) * on_sign).amax(-1)

    def _loss(self, scores: Tensor) -> Tensor:
        """The loss of scores [N] in [0, 1]."""
        if self.loss == "probability":
            return scores.mean()
        return log_odds(scores).mean()


def seen_at(boxes: Tensor, predictions: Predictions, label: int) -> Tensor:
    """[N] the highest score of a class among the predictions whose middle is in the box [N, 4] of their image; 0 without one."""
    middle = (predictions.boxes[..., :2] + predictions.boxes[..., 2:]) / 2
    inside = ((middle >= boxes[:, None, :2]) & (middle <= boxes[:, None, 2:])).all(-1)
    return (predictions.scores_of(label) * inside).amax(-1)


def cut_out(patch: Tensor, number: int, probability: float, generator: torch.Generator) -> Tensor:
    """[N, 3, P, P] copies of a patch [1, 3, P, P], each with this probability with a random grey square."""
    size = patch.shape[-1]
    side = round(CUT * size)
    begins = torch.randint(size - side + 1, (2, number, 1), generator=generator)
    rows, columns = (torch.arange(size) >= begins) & (torch.arange(size) < begins + side)
    chosen = torch.rand(number, 1, 1, generator=generator) < probability
    cut = rows[:, :, None] & columns[:, None, :] & chosen
    return torch.where(cut[:, None], 0.5, patch)


def total_variation(patch: Tensor) -> Tensor:
    """Mean absolute difference of neighbouring texels, vertical plus horizontal, of patches [..., H, W]."""
    down, across = patch.diff(dim=-2).abs(), patch.diff(dim=-1).abs()
    return down.mean() + across.mean()
