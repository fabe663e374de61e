"""Adversarial training of a detector with a skip probability (thesis Algorithm 5, applied to the patches of chapter 3)."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import torch
from annotated_types import Interval
from torch import Tensor

from cavbench import zoo
from cavbench.core.contracts import Facts, Progress, Trained
from cavbench.core.options import configured, parameter_words
from cavbench.core.ranges import Count, Natural, NotNegative, Positive, Share
from cavbench.detection import (
    STOP_SIGN,
    CameraWorld,
    Detector,
    DetectorDefense,
    DetectorVictim,
    PatchAttack,
    PatchThreat,
    Predictions,
    Scenes,
)
from cavbench.detection.access import PatchEnforcer
from cavbench.detection.boxes import detections
from cavbench.detection.scenes import FOREIGN
from cavbench.detection.sight import NMS_IOU
from cavbench.detection.victims.checkpoint import Checkpoint
from cavbench.detection.victims.examples import Example
from cavbench.detection.victims.learner import Learner
from cavbench.detection.victims.loss import missed, mistaken, unlike
from cavbench.detection.victims.training import descend
from cavbench.detection.victims.windows import Views, Windows, kept
from cavbench.errors import UserError

AWAY = 0.2
"""Share of the windows at uniformly random places; the others are near the sign."""
SEEN = 0.5
"""A sign with a smaller visible share is not a target."""
SURE = 0.4
"""The teacher's detections above this score are labels of the detector's own loss."""
DECAY = 0.98
"""Of the average of the weights, which is that of about the last 50 updates: a longer one would be close to the start."""
IN_THE_LOOP = (
    "steps=150 batch=6 window=160 learning_rate=0.5 loss=log_odds tv=0.05 rotation=0 scale=0 perspective=0 "
    "brightness=0 contrast=0 saturation=0 hue=0 noise=0"
)
"""Shifts only, in large steps: with small ones the patch is still weak after the last step."""


@dataclass(frozen=True, kw_only=True)
class DetectorAdversarialTraining(DetectorDefense):
    """Fine-tunes the detector with patches on the signs (thesis Algorithm 5; principle of Madry et al. 2018).

    In each round a patch is crafted against the current detector; then the detector is trained on windows of the training scenes
    with one of the newest patches on each sign. With probability `skip` a sign has no patch. If the world has decoys, a share of
    the windows has one in the place of the sign, with a patch as often as the signs. The loss asks the detector to find the sign
    despite the patch, to find none in decoys and elsewhere, and otherwise to keep its original predictions on the same window
    without a patch. The only label is the sign's box. A detector that was trained here (a `Learner`) keeps its own loss instead:
    what it detected in the window without a patch are the labels. `skip=1` is the control: the same training without patches.

    Tensors with more than `largest` values stay as they are, and the zoo stores only those that changed.

    Args:
        skip: probability that a sign or a decoy has no patch, in [0, 1].
        decoys: share of the windows that have a decoy in the place of the sign, in [0, 1].
        faces: what decoys show: faces drawn at random, or, of `signs`, also other words on the octagon, real signs, and foreign
            stop signs, which are found like the sign (`Decoy.family`).
        again: start from the detector that was trained with the default parameters.
        attack: any registered patch attack.
        attack_params: its parameters, as on the command line but separated by spaces.
        budget: side of the patches as a share of the sign's side, in (0, 1].
        rounds: number of crafted patches; each round also has other decoys.
        updates: weight updates per round.
        shown: number of newest patches in use; half of the windows have the latest one.
        batch: windows per update.
        window: side of a window in pixels, a multiple of the detector's stride.
        learning_rate: maximum learning rate of AdamW.
        fidelity: weight of keeping the original predictions, or of the detector's own loss, relative to finding the sign.
        caution: weight of finding no sign in decoys and elsewhere, relative to finding the sign; times `Learner.care`.
        largest: number of values of the largest tensors that are trained.
        trained: training seed of the zoo's detector; the seeds of a run are patch seeds.
        trained_in: non-default parameters of the training world; set by `bench train`.
    """

    training: ClassVar[int] = 4

    skip: Share = 0.3
    decoys: Share = 0.4
    faces: Literal["drawn", "signs"] = "drawn"
    again: bool = False
    attack: str = "eot"
    attack_params: str = IN_THE_LOOP
    budget: Annotated[float, Interval(gt=0, le=1)] = 0.5
    rounds: Count = 20
    updates: Count = 80
    shown: Count = 8
    batch: Count = 8
    window: Count = 224
    learning_rate: Positive = 3e-4
    fidelity: NotNegative = 0.3
    caution: NotNegative = 2.0
    largest: Count = 1_000_000
    trained: Natural = 0
    trained_in: str = ""

    @property
    def seeded(self) -> bool:
        return False

    def zoo_name(self, victim: DetectorVictim) -> str:
        return f"{victim.zoo_name()}-advtrain-{self.attack}-skip{self.skip:g}"

    def load(self, victim: DetectorVictim, seed: int, facts: Facts) -> Detector:
        return zoo.load(zoo.Recipe.of(victim, self), self.trained, lambda **_: victim.load(seed, facts))

    def train(self, victim: DetectorVictim, world: CameraWorld, *, seed: int, progress: Progress) -> Trained[Detector]:
        """Train the detector of training seed `seed`.

        Raises:
            UserError: if the attack crafts no patches.
        """
        attack = configured("attack", self.attack, parameter_words(self.attack_params)).component
        if not isinstance(attack, PatchAttack):
            raise UserError(
                f"attack {self.attack!r} makes no patches: adversarial training of a detector needs a patch attack"
            )
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            start = victim.load(seed, world.facts)
            if not start.aligned and not isinstance(victim, Learner):
                raise UserError(f"{type(victim).__name__} has no loss for adversarial training, and is not aligned")
            first = DetectorAdversarialTraining().load(victim, seed, world.facts) if self.again else start
            hardening = _Hardening(self, attack, victim, start, world.training_scenes(), seed, progress, first)
            # What cannot be kept in the zoo when it is done is not kept before.
            place = zoo.unfinished(zoo.Recipe.of(victim, self), seed) if victim.learns else None
            detector, seconds = descend(
                hardening.detector,
                hardening.loss,
                updates=self.rounds * self.updates,
                learning_rate=self.learning_rate,
                decay=DECAY,
                progress=progress,
                checkpoint=hardening.kept_at(place) if place else None,
            )
        card = {"attack": asdict(attack), "cpu_seconds": round(seconds)}  # type: ignore[call-overload]
        return Trained(detector.requires_grad_(False), card, start)


class _Hardening:
    """The training loss, and the patches crafted during the training."""

    def __init__(
        self,
        recipe: DetectorAdversarialTraining,
        attack: PatchAttack,
        victim: DetectorVictim,
        detector: Detector,
        scenes: Scenes,
        seed: int,
        progress: Progress,
        first: Detector | None = None,
    ) -> None:
        self.recipe, self.attack, self.scenes, self.progress = recipe, attack, scenes, progress
        self.learner = victim if isinstance(victim, Learner) else None
        self.caution = recipe.caution * (self.learner.care if self.learner else 1.0)
        # The undefended detector, whose other predictions are kept, and the one that the training starts from.
        self.teacher, self.detector = detector, copy.deepcopy(first or detector)
        self._train_weights()
        if not any(weight.requires_grad for weight in self.detector.parameters()):
            raise UserError(f"largest={recipe.largest} leaves no tensor of the detector to train: allow larger ones")
        self.label = detector.index(STOP_SIGN)
        self.generator = torch.Generator().manual_seed(seed)
        self.windows = Windows(scenes, recipe.window, away=AWAY, generator=self.generator)
        self.decoys: Tensor | None = None
        self.families: list[str] = []
        self.patches: list[Tensor] = []

    def loss(self, update: int) -> Tensor:
        """The loss of one update; the first update of each round crafts a patch and draws other decoys."""
        if update % self.recipe.updates == 0:
            self._begin(update // self.recipe.updates)
        views = self.windows.draw(self.recipe.batch)
        signs, plain = self._plain(views)
        shown, plain = self.windows.lit(self._patched(views, plain, signs), plain)
        with torch.no_grad():
            original = self.teacher(plain)
        current = self.detector(shown)
        boxes = views.boxes(self.scenes.boxes[views.frames], self.recipe.window)
        inside = ((boxes >= 0) & (boxes <= self.recipe.window)).all(1)
        stops = signs | self.of_family(views, FOREIGN)
        visible = stops & inside & (self.scenes.visible[views.frames] >= SEEN)
        found = (missed(current, self.label, boxes) * visible).mean()
        cautious = mistaken(current, self.label, boxes, stops).mean()
        if self.learner:
            faithful = self.learner.loss(self.detector, self._taught(shown, original, signs, visible & ~signs, boxes))
        else:
            # What the teacher says of decoys is no example.
            faithful = (unlike(current, original) * signs).mean()
        return found + self.caution * cautious + self.recipe.fidelity * faithful

    def _taught(self, shown: Tensor, original: Predictions, signs: Tensor, foreign: Tensor, places: Tensor) -> Example:
        """The windows with the teacher's detections; where decoys are, a stop sign is one of `foreign` alone, at its place."""
        boxes, labels = [], []
        taught = detections(original, threshold=SURE, iou=NMS_IOU)
        for found, real, other, place in zip(taught, signs.tolist(), foreign.tolist(), places, strict=True):
            kept_ones = found.labels != (-1 if real else self.label)
            boxes.append(torch.cat((found.boxes[kept_ones], place[None][: int(other)])))
            labels.append(torch.cat((found.labels[kept_ones], torch.full((int(other),), self.label))))
        return Example(shown, boxes, labels)

    def kept_at(self, path: Path) -> Checkpoint:
        """Where the training is kept after each round."""
        return Checkpoint(path, self.recipe.updates, self._held, self._restore)

    def _held(self) -> dict[str, Any]:
        return {"patches": self.patches, "generator": self.generator.get_state()}

    def _restore(self, held: Mapping[str, Any]) -> None:
        self.patches = list(held["patches"])
        self.generator.set_state(held["generator"])

    def _begin(self, number: int) -> None:
        """Begin a round: craft a patch, and draw decoys."""
        if self.recipe.skip < 1:
            self.patches = [*self.patches, self._crafted(number)][-self.recipe.shown :]
        if self.scenes.decoys and self.recipe.decoys:
            redrawn = self.scenes.redrawn(number, True) if self.recipe.faces == "signs" else self.scenes.redrawn(number)
            self.decoys = kept(redrawn, redrawn.render_decoys)
            self.families = [one.family for one in redrawn.decoys]

    def of_family(self, views: Views, family: str) -> Tensor:
        """The windows whose decoy, if they have one, is of a family, bool [N]."""
        return torch.tensor([bool(self.families) and self.families[frame] == family for frame in views.frames.tolist()])

    def _train_weights(self) -> None:
        """Let all tensors learn but those that are too large."""
        for weight in self.detector.parameters():
            weight.requires_grad_(weight.numel() <= self.recipe.largest)

    def _crafted(self, number: int) -> Tensor:
        """Craft patch `number` against the current detector."""

        def tell(share: float, text: str) -> None:
            self.progress(number / self.recipe.rounds, f"patch {number + 1}, {share:.0%}: {text}")

        threat = PatchThreat(budget=self.recipe.budget)
        oracle = PatchEnforcer(self.detector.requires_grad_(False), threat, self.attack.access, self.generator).oracle
        patch = self.attack.craft(oracle, self.scenes, tell)
        self._train_weights()
        if patch is None:
            raise UserError(f"attack {self.recipe.attack!r} makes no patch to train with")
        return threat.project(patch)[0]

    def _plain(self, views: Views) -> tuple[Tensor, Tensor]:
        """Which windows have the sign, bool [N], and the windows without patches; the others have a decoy."""
        plain = self.windows.cut(views)
        if self.decoys is None:
            return torch.ones(len(plain), dtype=torch.bool), plain
        signs = torch.rand(len(plain), generator=self.generator) >= self.recipe.decoys
        if not signs.all():
            others = views[~signs]
            plain[~signs] = self.windows.cut(others, self.decoys[others.frames])
        return signs, plain

    def _patched(self, views: Views, plain: Tensor, signs: Tensor) -> Tensor:
        """The windows, with patches on the signs and the decoys except where skipped."""
        attacked = torch.rand(len(plain), generator=self.generator) >= self.recipe.skip
        # A patch may hide the word: then nobody can tell the sign from an octagon with another one.
        attacked &= signs | ~self.of_family(views, "words")
        if not attacked.any():
            return plain
        which = torch.randint(len(self.patches), (len(plain),), generator=self.generator)
        which[::2] = len(self.patches) - 1
        one = views[attacked]
        patches = torch.stack([self.patches[number] for number in which[attacked]])
        with torch.no_grad():
            signed = self.windows.cut(one, self.scenes.render(one.frames, patches, self.recipe.budget))
        shown = plain.clone()
        # A patch looks the same on the face of a decoy: only its pixels are taken.
        taken = signs[attacked, None, None] | self._on_patch(one)
        shown[attacked] = torch.where(taken[:, None], signed, plain[attacked])
        return shown

    def _on_patch(self, views: Views) -> Tensor:
        """The pixels of the windows that a patch covers, bool [N, window, window]."""
        boxes = views.boxes(self.scenes.boxes[views.frames], self.recipe.window)
        middle, half = (boxes[:, :2] + boxes[:, 2:]) / 2, self.recipe.budget * (boxes[:, 2:] - boxes[:, :2]) / 2
        pixels = torch.arange(self.recipe.window) + 0.5
        across, down = ((pixels - middle[:, axis, None]).abs() <= half[:, axis, None] for axis in (0, 1))
        return down[:, :, None] & across[:, None]
