"""Patch segmentation and completion before a detector: pixels that look pasted are filled from their surroundings."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import torch
from annotated_types import Interval
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, interpolate, max_pool2d

from cavbench.core.contracts import Facts, Progress, Trained
from cavbench.core.ranges import Count, Natural, Positive, Share
from cavbench.defenses.detection import shared
from cavbench.defenses.detection.completion import closed, filled
from cavbench.defenses.detection.marker import Marker
from cavbench.defenses.detection.textures import textures
from cavbench.detection import CameraWorld, Detector, DetectorDefense, DetectorVictim, Predictions, Scenes, Wrapped
from cavbench.detection.victims.training import descend
from cavbench.detection.victims.windows import Windows
from cavbench.errors import UserError

AWAY = 0.3
"""Share of the training windows at uniformly random places; the others are near the sign."""
TEXELS = 64
"""Side of a training texture."""
BANK, STEP, REPLACED = 96, 0.08, 0.02
"""Textures in the bank, the size of a step up the loss, and the probability that a texture is replaced at a step."""
BESIDE = 0.5
"""Share of the windows with a texture at a random place."""
VISIBLE = 0.02
"""Pixels that a patch can change by less than this are not part of it: they are beyond its edge, or hidden."""
DECAY = 0.99
"""Of the average of the weights, per update."""
CERTAINTY = 0.8
"""Chosen on the training scenes: a lower one fills more of the sign around a texture, and confidence is lost."""
CLOSING = 2
"""Radius of the closing of the marks, in pixels at half the image's resolution."""
SMOOTH = 4.0
"""The backward pass divides log-odds by this: the gradient of a sure mark is small, but does not vanish."""


class Completed(Wrapped):
    """A detector whose input is completed: marked pixels are filled from those around them.

    Pixels are filled wholly or not at all. That has no useful gradient, so the backward pass is that of the same completion with
    soft marks, sigmoid(log-odds / `SMOOTH`) (BPDA, Athalye et al. 2018). An adaptive attack so learns how to avoid marks, and
    what the pixels do where they are not marked.

    Args:
        inner: the detector.
        marker: marks pixels.
        certainty: pixels with a higher probability of being a patch are filled, in (0, 1).
    """

    def __init__(self, inner: Detector, marker: nn.Module, certainty: float) -> None:
        super().__init__(inner)
        self.marker, self.least = marker, math.log(certainty / (1 - certainty))
        self.shape: dict[str, object] = {}

    def predict(self, pictures: Tensor) -> Predictions:
        odds = self.log_odds(pictures)
        shown = filled(pictures, (odds <= 0).to(odds))
        if torch.is_grad_enabled():
            soft = filled(pictures, (-odds / SMOOTH).sigmoid())
            shown = soft + (shown - soft).detach()
        return self.inner.predict(shown)

    def log_odds(self, pictures: Tensor) -> Tensor:
        """[N, 1, H, W], above 0 where images [N, 3, H, W] are filled."""
        odds = closed(self.marker(pictures) - self.least, CLOSING)
        return interpolate(odds, scale_factor=2.0)[..., : pictures.shape[2], : pictures.shape[3]]

    def transform(self, pictures: Tensor) -> Tensor:
        """The images [N, 3, H, W] that the detector sees."""
        return filled(pictures, (self.log_odds(pictures) <= 0).to(pictures))


@dataclass(frozen=True, kw_only=True)
class Segmenter(DetectorDefense):
    """Segment and complete: a small U-Net marks pixels of patches, which are then filled from their surroundings.

    In the manner of SAC (Liu et al. 2022, arXiv 2112.04532) and NutNet (Lin et al. 2024): the U-Net is trained on clean training
    frames with random textures on signs and elsewhere. It meets no detector and no attack of the benchmark. A share of the
    textures comes from a bank that learns to avoid marks, as in the self-adversarial training of SAC, here with the gradients
    of the training's own backward passes (free adversarial training, Shafahi et al. 2019).

    Args:
        certainty: pixels with a higher probability of being a patch are filled, in (0, 1). It is not part of the training.
        updates: weight updates of the training.
        batch: windows per update.
        window: side of a window in pixels.
        learning_rate: maximum learning rate of AdamW.
        bare: share of the windows without a texture, in [0, 1].
        hard: share of the textures on signs that come from the bank, in [0, 1]; 0 is the control.
        trained: training seed of the zoo's U-Net; the seeds of a run are patch seeds.
        trained_in: non-default parameters of the training world; set by `bench train`.
    """

    certainty: Annotated[float, Interval(gt=0, lt=1)] = CERTAINTY
    updates: Count = 600
    batch: Count = 12
    window: Count = 192
    learning_rate: Positive = 4e-3
    bare: Share = 0.4
    hard: Share = 0.5
    trained: Natural = 0
    trained_in: str = ""

    @property
    def hardens(self) -> bool:
        return False

    @property
    def seeded(self) -> bool:
        return False

    def zoo_name(self, victim: DetectorVictim) -> str:
        return f"{victim.zoo_name()}-segmenter"

    def load(self, victim: DetectorVictim, seed: int, facts: Facts) -> Detector:
        as_trained, marker = replace(self, certainty=CERTAINTY), Marker()

        def defended() -> Completed:
            return self._around(victim.load(seed, facts), marker)

        return shared.load(as_trained, victim, self.trained, name="marker", part=marker, defended=defended)

    def train(self, victim: DetectorVictim, world: CameraWorld, *, seed: int, progress: Progress) -> Trained[Detector]:
        """Train the U-Net of training seed `seed`. The victim plays no part: all get the same U-Net.

        Raises:
            UserError: if `certainty` is not its default.
        """
        if self.certainty != CERTAINTY:
            raise UserError("certainty is no part of the training: leave it out, and set it in `bench run`")
        start = victim.load(seed, world.facts)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            examples = _Examples(self, world.training_scenes(), seed)
            marker, seconds = descend(
                examples.marker,
                examples.loss,
                updates=self.updates,
                learning_rate=self.learning_rate,
                decay=DECAY,
                progress=progress,
            )
        network = self._around(start, marker)
        return Trained(network, {"cpu_seconds": round(seconds)}, self._around(start, nn.Identity()))

    def _around(self, inner: Detector, marker: nn.Module) -> Completed:
        return Completed(inner, marker, self.certainty).requires_grad_(False).eval()


class _Examples:
    """Training windows with pasted textures."""

    def __init__(self, recipe: Segmenter, scenes: Scenes, seed: int) -> None:
        self.recipe, self.scenes, self.marker = recipe, scenes, Marker().train()
        self.generator = torch.Generator().manual_seed(seed)
        self.windows = Windows(scenes, recipe.window, away=AWAY, generator=self.generator)
        self.bank = self._textures(BANK)
        self.signs: Tensor | None = None

    def loss(self, update: int) -> Tensor:
        """Cross-entropy plus Dice loss (Milletari et al. 2016, Eq. 2, as 1 - D), of the marks of one batch of windows."""
        self._harden()
        shown, pasted = self._drawn()
        odds, wanted = self.marker(shown), max_pool2d(pasted, 2)
        marks = odds.sigmoid()
        dice = (2 * (marks * wanted).sum() + 1) / (marks.square().sum() + wanted.sum() + 1)
        return binary_cross_entropy_with_logits(odds, wanted) + 1 - dice

    def _harden(self) -> None:
        """Move the latest textures of the bank up the loss, and replace some by new ones."""
        if self.signs is None or self.signs.grad is None:
            return
        harder = (self.signs.detach() + STEP * self.signs.grad.sign()).clamp(0, 1)
        new = torch.rand(len(harder), 1, 1, 1, generator=self.generator) < REPLACED
        harder = torch.where(new, self._textures(len(harder)), harder)
        self.bank[self.taken[self.hard]] = harder[self.hard]

    def _drawn(self) -> tuple[Tensor, Tensor]:
        """Windows [N, 3, side, side], and which pixels have a texture, float [N, 1, side, side]."""
        side, count = self.recipe.window, self.recipe.batch
        views = self.windows.draw(count)
        # All signs of a batch have textures of one size: rendering takes one.
        share = self._between(0.2, 0.8)

        def rendered(patches: Tensor) -> Tensor:
            return self.scenes.windows(views.frames, patches, share, views.corners.long(), (side, side))

        self.taken = torch.randperm(len(self.bank), generator=self.generator)[:count]
        self.hard = self._chance(count, self.recipe.hard)
        self.signs = torch.where(self.hard[:, None, None, None], self.bank[self.taken], self._textures(count))
        light = rendered(torch.ones_like(self.signs)) - rendered(torch.zeros_like(self.signs))
        pasted = (light.amax(1, keepdim=True) > VISIBLE).float()
        plain = self.windows.cut(views)
        shown = torch.where(pasted > 0, rendered(self.signs.requires_grad_(self.recipe.hard > 0)), plain)
        where, beside = self._pasted()
        shown, pasted = torch.where(where, beside, shown), pasted.maximum(where.float())
        bare = self._chance(count, self.recipe.bare)[:, None, None, None]
        (shown,) = self.windows.lit(torch.where(bare, plain, shown))
        return shown, pasted * ~bare

    def _pasted(self) -> tuple[Tensor, Tensor]:
        """Textures at random places, in random sizes and light.

        Returns:
            Where they are, bool [N, 1, side, side], and the pixels [N, 3, side, side].
        """
        side, count = self.recipe.window, self.recipe.batch
        where, pixels = torch.zeros(count, 1, side, side, dtype=torch.bool), torch.zeros(count, 3, side, side)
        for number in self._chance(count, BESIDE).nonzero().flatten().tolist():
            size = round(8 * (side / 24) ** self._between(0, 1))
            x, y = (int(self._between(0, side - size)) for _ in range(2))
            texture = interpolate(self._textures(1), (size, size), mode="bilinear", antialias=True)[0]
            pixels[number, :, y : y + size, x : x + size] = self._between(0.4, 1) * texture
            where[number, :, y : y + size, x : x + size] = True
        return where, pixels

    def _textures(self, count: int) -> Tensor:
        return textures(count, TEXELS, self.windows.pictures, self.generator)

    def _chance(self, count: int, share: float) -> Tensor:
        """bool [count], each true with probability `share`."""
        return torch.rand(count, generator=self.generator) < share

    def _between(self, low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand(1, generator=self.generator))
