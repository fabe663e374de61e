"""Masking with a certificate: a stop sign is also found by its rim alone, where a patch in its middle is never seen."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from cavbench.core.contracts import Facts, Progress, Trained
from cavbench.core.ranges import Count, Natural, Positive
from cavbench.defenses.detection import shared
from cavbench.defenses.detection.judge import (
    COARSER,
    COVER,
    FINEST,
    LEVELS,
    NEVER,
    SIGN,
    STEP,
    WINDOW,
    Judge,
    best_of_blocks,
    bound,
    levels,
)
from cavbench.detection import (
    STOP_SIGN,
    CameraWorld,
    Detector,
    DetectorDefense,
    DetectorVictim,
    Predictions,
    Scenes,
    Wrapped,
)
from cavbench.detection.boxes import overlap
from cavbench.detection.sight import SAME_IOU
from cavbench.detection.victims.training import descend
from cavbench.detection.victims.windows import Views, Windows, kept

MIDDLE = 4.0
"""Log-odds of the judge with a score of one half. In the training frames 19 of 20 signs have certified log-odds above 10.0,
and 19 of 20 decoys that it was not trained with have log-odds below -2.1: this lies in the middle."""

SIDE = 96
"""Side in pixels of a training picture, which has 25 x 25 windows."""
OTHERS, AWAY, MISTAKEN = 0.45, 0.35, 0.7
"""Share of the training pictures that show a decoy, share of those away from the sign, and share of these at a mistake."""
RED = 0.5
"""Share of the decoys that get the hue of the sign."""
ROUNDS, LOOKED_AT, MISTAKES = 8, 54, 4
"""How often decoys are drawn and mistakes are looked for, in how many frames, and how many of each frame are remembered."""
LARGEST = 40.5
"""A window is not one of a sign that is wider in it than this, in pixels."""
SLACK = 2.5
"""Nor of one that it could be this much nearer to: its cover must hide the patch, and not much more."""
MARGIN = 1.5
"""A patch changes pixels up to this far beyond its edge, in pixels of the image."""
PATCH = 0.5
"""Side of a patch as a share of the sign's side: in training, a window must cover it."""
HARDEST = 16
"""Of the windows without a sign in a training picture, this many count: those that look most like one."""
SEEN_AT_A_GLANCE = 20.0
"""Weight of a window with a sign among the windows without one, for the answer at a glance: no sign may be lost there."""
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
            torch.cat([known.objectness, (odds - MIDDLE).sigmoid()], 1),
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
        return (sure - MIDDLE).sigmoid()


@dataclass(frozen=True, kw_only=True)
class Masking(DetectorDefense):
    """Masking with a certificate: a small network says from the rim of a window whether it shows a stop sign.

    In the manner of ObjectSeeker (Xiang et al. 2023, arXiv 2202.01811): for every place and size of a patch in the middle of a
    sign there is a window in which the patch is hidden, and a detection there counts, whatever is detected elsewhere. The windows
    are the same in all images. The detector's own predictions are kept, so the sign is never seen worse than without the defence.

    The network meets no detector and no attack of the benchmark, so one serves all victims. It learns from clean training frames
    with signs and decoys.

    Args:
        updates: weight updates of the training.
        batch: pictures per update.
        learning_rate: maximum learning rate of AdamW.
        trained: training seed of the zoo's network; the seeds of a run are patch seeds.
        trained_in: non-default parameters of the training world; set by `bench train`.
    """

    updates: Count = 1400
    batch: Count = 32
    learning_rate: Positive = 4e-3
    trained: Natural = 0
    trained_in: str = ""

    @property
    def hardens(self) -> bool:
        return False

    @property
    def seeded(self) -> bool:
        return False

    def zoo_name(self, victim: DetectorVictim) -> str:
        return f"{victim.zoo_name()}-masking"

    def load(self, victim: DetectorVictim, seed: int, facts: Facts) -> Detector:
        judge = Judge()

        def defended() -> Masked:
            return _around(victim.load(seed, facts), judge)

        network = shared.load(self, victim, self.trained, name="judge", part=judge, defended=defended)
        judge.freeze()
        return network

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
        self.mistakes = torch.zeros(0, 4)

    def loss(self, update: int) -> Tensor:
        """Cross-entropy: mean over the windows of a sign, plus mean over the hardest windows without one, of each picture.

        The answer at a glance has the same loss, with other weights.
        """
        self._redrawn(update)
        shown, views, signs = self._drawn()
        wanted, other = self._labels(views, signs)
        shares = wanted / wanted.sum((1, 2), keepdim=True).clamp(min=1) / wanted.flatten(1).any(1).sum().clamp(min=1)
        losses = []
        for odds, weight in zip(self.judge.both(shown), (SEEN_AT_A_GLANCE, 1.0), strict=True):
            hardest = odds[:, 0].masked_fill(~other, -torch.inf).flatten(1).topk(HARDEST).values
            losses.append(weight * (softplus(-odds[:, 0]) * shares).sum() + softplus(hardest).mean())
        return sum(losses[1:], losses[0])

    def _redrawn(self, update: int) -> None:
        """Draw the next set of decoys when it is time, and look for mistakes."""
        number, since = divmod(update, max(1, self.recipe.updates // ROUNDS))
        if since:
            return
        if self.scenes.decoys:
            self.decoys = kept(self.scenes, self.scenes.redrawn(number).render_decoys)
        if number:
            self.judge.eval()
            frames = torch.randperm(len(self.scenes), generator=self.generator)[:LOOKED_AT]
            found = [self._mistaken(frame) for frame in frames.tolist()]
            self.mistakes = torch.cat([self.mistakes, *found])
            self.judge.train()

    @torch.no_grad()
    def _mistaken(self, frame: int) -> Tensor:
        """The windows of a frame without a sign that look most like one: frame, middle and size of a pixel, [MISTAKES, 4]."""
        picture = (self.windows.pictures if self.decoys is None else self.decoys)[frame, None] / 255
        found = [best_of_blocks(self.judge(level.pictures), level.boxes) for level in levels(picture)]
        odds, boxes = (torch.cat(parts, 1)[0] for parts in zip(*found, strict=True))
        if self.decoys is None:
            odds = odds.masked_fill(overlap(boxes, self.scenes.boxes[frame]) > 0, NEVER)
        worst = boxes[odds.topk(MISTAKES).indices]
        middles, scale = (worst[:, :2] + worst[:, 2:]) / 2, (worst[:, 2:] - worst[:, :2]).mean(1, keepdim=True) / SIGN
        return torch.cat([torch.full((MISTAKES, 1), frame), middles, scale], 1)

    def _drawn(self) -> tuple[Tensor, Views, Tensor]:
        """Pictures [N, 3, SIDE, SIDE] with their places, and which show the frame with its sign, bool [N]."""
        count = self.recipe.batch
        views = self._views(count)
        signs = torch.ones(count, dtype=torch.bool)
        shown = self.windows.cut(views)
        if self.decoys is not None:
            signs = self._uniform(count) >= OTHERS
            others = self.windows.cut(views, self.decoys[views.frames])
            others = torch.where(
                self._uniform(count, 1, 1, 1) < RED, self._reddened(others, shown, self._true(views)), others
            )
            shown = torch.where(signs[:, None, None, None], shown, others)
        (shown,) = self.windows.lit(shown)
        return shown, views, signs

    def _reddened(self, others: Tensor, shown: Tensor, boxes: Tensor) -> Tensor:
        """Pictures of decoys whose mean hue, in the boxes [N, 4] of the signs, is that of the sign in the other pictures.

        Hues are turned in the plane of the two differences of colour of YIQ, the television standard NTSC.
        """
        place = torch.arange(SIDE) + 0.5
        across, down = ((place >= boxes[:, axis, None]) & (place <= boxes[:, axis + 2, None]) for axis in (0, 1))
        inside = (down[:, :, None] & across[:, None, :])[:, None]
        yiq = torch.tensor([[0.299, 0.587, 0.114], [0.5959, -0.2746, -0.3213], [0.2115, -0.5227, 0.3112]])
        angles = []
        for pictures in (shown, others):
            mean = (pictures * inside).sum((2, 3)) @ yiq.T
            angles.append(torch.atan2(mean[:, 2], mean[:, 1]))
        turn = angles[0] - angles[1]
        cos, sin, zero = turn.cos(), turn.sin(), torch.zeros_like(turn)
        turned = torch.stack([zero + 1, zero, zero, zero, cos, -sin, zero, sin, cos], 1).view(-1, 3, 3)
        change = torch.linalg.inv(yiq) @ turned @ yiq
        return torch.where(inside, torch.einsum("nij,njhw->nihw", change, others).clamp(0, 1), others)

    def _views(self, count: int) -> Views:
        """Squares around the sign in which it is about as wide as in a window; others at mistakes or random places."""
        frames = torch.randint(len(self.scenes), (count,), generator=self.generator)
        box, limit = self.scenes.boxes[frames], torch.tensor(self.scenes.size[::-1])
        sides = SIDE / SIGN * (box[:, 2:] - box[:, :2]).amax(1) * self._between(0.9, 1.12, count)
        middle = (box[:, :2] + box[:, 2:]) / 2 + (self._uniform(count, 2) - 0.5) * 0.5 * sides[:, None]
        away = self._uniform(count) < AWAY
        sides = torch.where(away, SIDE * self._between(FINEST, FINEST * COARSER ** (LEVELS - 1), count), sides)
        middle = torch.where(away[:, None], self._uniform(count, 2) * limit, middle)
        if len(self.mistakes):
            chosen = self.mistakes[torch.randint(len(self.mistakes), (count,), generator=self.generator)]
            again = away & (self._uniform(count) < MISTAKEN)
            frames = torch.where(again, chosen[:, 0].long(), frames)
            sides = torch.where(again, SIDE * chosen[:, 3] * self._between(0.9, 1.1, count), sides)
            beside = (self._uniform(count, 2) - 0.5) * 0.3 * sides[:, None]
            middle = torch.where(again[:, None], chosen[:, 1:3] + beside, middle)
        sides = sides.clamp(max=float(limit.min())).round()
        corners = (middle - sides[:, None] / 2).round().clamp(min=0).minimum(limit - sides[:, None])
        return Views(frames, corners, sides)

    def _true(self, views: Views) -> Tensor:
        """[N, 4] boxes of the signs in the training pictures."""
        return views.boxes(self.scenes.boxes[views.frames], SIDE)

    def _labels(self, views: Views, signs: Tensor) -> tuple[Tensor, Tensor]:
        """Which windows [N, h, w] are those of a sign, and which are of none; the others do not count."""
        place = (torch.arange((SIDE - WINDOW) // STEP + 1) * STEP + WINDOW / 2).float()
        middles = torch.stack(torch.meshgrid(place, place, indexing="xy"), -1)
        own = torch.cat([middles - SIGN / 2, middles + SIGN / 2], -1)
        true = self._true(views)[:, None, None]
        wide = (true[..., 2:] - true[..., :2]).amax(-1)
        beside = (middles - (true[..., :2] + true[..., 2:]) / 2).abs().amax(-1)
        needed = PATCH / 2 * wide + MARGIN * (SIDE / views.sides)[:, None, None]
        slack = COVER / 2 - beside - needed
        fits = (slack >= 0) & (slack <= SLACK) & (wide <= LARGEST)
        there = signs[:, None, None]
        return fits & there, (overlap(own, true) < SAME_IOU) | ~there

    def _uniform(self, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=self.generator)

    def _between(self, low: float, high: float, count: int) -> Tensor:
        """[count], log-uniform."""
        return low * (high / low) ** self._uniform(count)
