"""Masking with a certificate: a stop sign is also found by its rim alone, where a patch in its middle is never seen."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits

from bench.detection import (
    STOP_SIGN,
    CameraWorld,
    Detector,
    DetectorDefense,
    DetectorVictim,
    Predictions,
    Scenes,
    Wrapped,
)
from bench.detection.boxes import overlap
from bench.detection.sight import SAME_IOU
from bench.plugins.contracts import Facts, Progress, Trained
from bench.plugins.ranges import Count, Natural, Positive
from bench.victims import zoo
from bench.victims.detectors.training import descend
from bench.victims.detectors.windows import Views, Windows, kept
from defenses.judge import COARSER, COVER, FINEST, LEVELS, SIGN, STEP, WINDOW, Judge, best_of_blocks, bound, levels

SIDE = 96
"""Side in pixels of a training picture, which has 29 x 29 windows."""
OTHERS, AWAY = 0.4, 0.35
"""Share of the training pictures that show a decoy, and share of those at random places."""
FACES = 8
"""Sets of decoys that are drawn for the training."""
SIZES = (26.0, 38.0)
"""A window is one of a sign if that is this wide in it, in pixels."""
MARGIN = 1.5
"""A patch changes pixels up to this far beyond its edge, in pixels of the image."""
PATCH = 0.5
"""Side of a patch as a share of the sign's side: in training, a window must cover it."""
HARDEST = 16
"""Of the windows without a sign in a training picture, this many count: those that look most like one."""
DECAY = 0.995
"""Of the average of the weights, per update."""


class Masked(Wrapped):
    """A detector whose predictions are joined by those of a judge that never looks at the middle of a window.

    Args:
        inner: the detector.
        judge: the judge.
    """

    def __init__(self, inner: Detector, judge: nn.Module) -> None:
        super().__init__(inner)
        self.judge, self.label = judge, inner.index(STOP_SIGN)
        self.shape: dict[str, object] = {}

    def predict(self, pictures: Tensor) -> Predictions:
        known = self.inner.predict(pictures)
        found = [best_of_blocks(self.judge(level.pictures), level.boxes) for level in levels(pictures)]
        if not found:
            return known
        odds, boxes = (torch.cat(parts, 1) for parts in zip(*found, strict=True))
        classes = odds.new_zeros(*odds.shape, len(self.names))
        classes[..., self.label] = 1
        return Predictions(
            torch.cat([known.boxes, boxes], 1),
            torch.cat([known.objectness, odds.sigmoid()], 1),
            torch.cat([known.classes, classes], 1),
        )

    @torch.no_grad()
    def certified(self, pictures: Tensor, boxes: Tensor, reach: Tensor) -> Tensor | None:
        if self.initial() is not None:
            return None  # A memory makes something else of the predictions.
        height, width = pictures.shape[2:]
        patch = reach.clamp(min=0).minimum(reach.new_tensor([width, height] * 2))[:, None, None]
        sure = pictures.new_full((len(pictures),), -torch.inf)
        for level in levels(pictures):
            covers = level.covers
            usable = (covers[..., :2] <= patch[..., :2]).all(-1) & (covers[..., 2:] >= patch[..., 2:]).all(-1)
            found = overlap(level.boxes, boxes[:, None, None]) >= SAME_IOU
            sure = sure.maximum(bound(self.judge(level.pictures), usable, found))
        return sure.sigmoid()


@dataclass(frozen=True, kw_only=True)
class Masking(DetectorDefense):
    """Masking with a certificate: a small network says from the rim of a window whether it shows a stop sign.

    In the manner of ObjectSeeker (Xiang et al. 2023, arXiv 2202.01811): for every place and size of a patch in the middle of a
    sign there is a window in which the patch is hidden, and a detection there counts, whatever is detected elsewhere. The windows
    are the same in all images. The detector's own predictions are kept, so the sign is never seen worse than without the defence.

    The network meets no detector and no attack of the benchmark. It learns from clean training frames with signs and decoys.

    Args:
        updates: weight updates of the training.
        batch: pictures per update.
        learning_rate: maximum learning rate of AdamW.
        trained: training seed of the zoo's network; the seeds of a run are patch seeds.
        trained_in: non-default parameters of the training world; set by `bench train`.
    """

    updates: Count = 2000
    batch: Count = 32
    learning_rate: Positive = 4e-3
    trained: Natural = 0
    trained_in: str = ""

    @property
    def trains(self) -> bool:
        return False

    def zoo_name(self, victim: DetectorVictim) -> str:
        return f"{victim.zoo_name()}-masking"

    def load(self, victim: DetectorVictim, seed: int, facts: Facts) -> Detector:
        recipe = zoo.Recipe.of(victim, self)
        return zoo.load(recipe, self.trained, lambda **_: _around(victim.load(seed, facts), Judge()))

    def train(self, victim: DetectorVictim, world: CameraWorld, *, seed: int, progress: Progress) -> Trained[Detector]:
        """Train the judge of training seed `seed`. The victim plays no part: all get the same judge."""
        start = victim.load(seed, world.facts)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            examples = _Examples(self, world.training_scenes(), seed)
            judge, seconds = descend(
                examples.judge,
                examples.loss,
                updates=self.updates,
                learning_rate=self.learning_rate,
                decay=DECAY,
                progress=progress,
            )
        network = _around(start, judge)
        return Trained(network, {"cpu_seconds": round(seconds)}, _around(start, nn.Identity()))


def _around(inner: Detector, judge: nn.Module) -> Masked:
    return Masked(inner, judge).requires_grad_(False).eval()


class _Examples:
    """Training pictures with signs, with decoys and without either."""

    def __init__(self, recipe: Masking, scenes: Scenes, seed: int) -> None:
        self.recipe, self.scenes, self.judge = recipe, scenes, Judge().train()
        self.generator = torch.Generator().manual_seed(seed)
        self.windows = Windows(scenes, SIDE, away=AWAY, generator=self.generator)
        self.decoys: Tensor | None = None

    def loss(self, update: int) -> Tensor:
        """Cross-entropy: mean over the windows of a sign, plus mean over the hardest windows without one, of each picture."""
        self._redrawn(update)
        shown, views, signs = self._drawn()
        odds = self.judge(shown)[:, 0]
        wanted, other = self._labels(views, signs)
        missed = binary_cross_entropy_with_logits(odds, torch.ones_like(odds), reduction="none")
        hardest = odds.masked_fill(~other, -torch.inf).flatten(1).topk(HARDEST).values
        with_sign = wanted.flatten(1).any(1)
        shares = wanted / wanted.sum((1, 2), keepdim=True).clamp(min=1)
        return (missed * shares).sum() / with_sign.sum().clamp(min=1) + nn.functional.softplus(hardest).mean()

    def _redrawn(self, update: int) -> None:
        """Draw the next set of decoys when it is time."""
        number, each = divmod(update, max(1, self.recipe.updates // FACES))
        if self.scenes.decoys and each == 0:
            self.decoys = kept(self.scenes, self.scenes.redrawn(number).render_decoys)

    def _drawn(self) -> tuple[Tensor, Views, Tensor]:
        """Pictures [N, 3, SIDE, SIDE] with their places, and which show the frame with its sign, bool [N]."""
        count = self.recipe.batch
        views = self._views(count)
        signs = torch.ones(count, dtype=torch.bool)
        shown = self.windows.cut(views)
        if self.decoys is not None:
            signs = self._uniform(count) >= OTHERS
            others = self.windows.cut(views, self.decoys[views.frames])
            shown = torch.where(signs[:, None, None, None], shown, others)
        (shown,) = self.windows.lit(shown)
        return shown, views, signs

    def _views(self, count: int) -> Views:
        """Squares around the sign in which it is about as wide as in a window; some at random places, in a random size."""
        frames = torch.randint(len(self.scenes), (count,), generator=self.generator)
        box, limit = self.scenes.boxes[frames], torch.tensor(self.scenes.size[::-1])
        wide = (box[:, 2:] - box[:, :2]).amax(1)
        near = SIDE / SIGN * wide * self._between(0.8, 1.25, count)
        far = SIDE * self._between(FINEST, FINEST * COARSER ** (LEVELS - 1), count)
        away = self._uniform(count) < AWAY
        sides = torch.where(away, far, near).clamp(max=float(limit.min())).round()
        middle = (box[:, :2] + box[:, 2:]) / 2 + (self._uniform(count, 2) - 0.5) * 0.6 * sides[:, None]
        middle = torch.where(away[:, None], self._uniform(count, 2) * limit, middle)
        corners = (middle - sides[:, None] / 2).round().clamp(min=0).minimum(limit - sides[:, None])
        return Views(frames, corners, sides)

    def _labels(self, views: Views, signs: Tensor) -> tuple[Tensor, Tensor]:
        """Which windows [N, h, w] are those of a sign, and which are of none; the others do not count."""
        place = (torch.arange((SIDE - WINDOW) // STEP + 1) * STEP + WINDOW / 2).float()
        middles = torch.stack(torch.meshgrid(place, place, indexing="xy"), -1)
        own = torch.cat([middles - SIGN / 2, middles + SIGN / 2], -1)
        true = views.boxes(self.scenes.boxes[views.frames], SIDE)[:, None, None]
        wide = (true[..., 2:] - true[..., :2]).amax(-1)
        beside = (middles - (true[..., :2] + true[..., 2:]) / 2).abs().amax(-1)
        needed = PATCH / 2 * wide + 0.5 + MARGIN * (SIDE / views.sides)[:, None, None]
        fits = (beside + needed <= COVER / 2) & (wide >= SIZES[0]) & (wide <= SIZES[1])
        there = signs[:, None, None]
        return fits & there, (overlap(own, true) < SAME_IOU) | ~there

    def _uniform(self, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=self.generator)

    def _between(self, low: float, high: float, count: int) -> Tensor:
        """[count], log-uniform."""
        return low * (high / low) ** self._uniform(count)
