"""The detection track: detectors, camera worlds, and the base classes of its components.

A detector takes pictures and gives boxes with scores, differentiable to the pixel.

A box is [x1, y1, x2, y2] in pixels of the picture given: x to the right, y down, from the outer corner of the first pixel.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor, nn

from bench.errors import UserError
from bench.plugins.contracts import Attack, Defense, Progress, Track, Trained, Victim, World
from bench.plugins.registry import unknown

if TYPE_CHECKING:
    from bench.detection.threat import VisionOracle
    from bench.scenarios.grid import Cell


@dataclass(frozen=True)
class Predictions:
    """Everything a detector says of N pictures before anything is thrown away, with the graph back to the pixels.

    Args:
        boxes: [N, K, 4] in pixels; they may reach beyond the picture.
        objectness: [N, K] in [0, 1], the probability that there is an object at all.
        classes: [N, K, C] in [0, 1], the probability of each class if there is one; they need not sum to 1.
    """

    boxes: Tensor
    objectness: Tensor
    classes: Tensor

    @property
    def scores(self) -> Tensor:
        """[N, K, C] in [0, 1]: objectness times class probability (Redmon et al. 2016, Eq. 1)."""
        return self.objectness.unsqueeze(-1) * self.classes

    def scores_of(self, label: int) -> Tensor:
        """[N, K] the scores of one class, without those of the others."""
        return self.objectness * self.classes[..., label]


STOP_SIGN = "stop sign"
"""The class to hide, as detectors name it."""


@dataclass(frozen=True)
class Objects:
    """What there is to find in a picture: boxes [K, 4] in pixels, and the name of the class of each."""

    boxes: Tensor
    names: tuple[str, ...]


@dataclass(frozen=True)
class Detections:
    """The objects found in one picture, best first: boxes [M, 4] in pixels, scores [M] in [0, 1], labels int64 [M]."""

    boxes: Tensor
    scores: Tensor
    labels: Tensor


class Detector(nn.Module, ABC):
    """An object detector whose every picture of a batch is looked at by itself."""

    names: tuple[str, ...]
    """Of the classes, by label."""
    stride: int
    """Height and width of a picture must be multiples of it."""
    weights_sha256: str = ""
    """Hash of the weights file it was loaded from; empty where there is none."""
    half_precision: ClassVar[bool] = True
    """Whether the zoo stores its kernels in half precision."""

    @abstractmethod
    def predict(self, pictures: Tensor) -> Predictions:
        """What `forward` returns, for pictures whose shape is right."""

    def forward(self, pictures: Tensor) -> Predictions:
        """All predictions for a batch of pictures.

        Args:
            pictures: float [N, 3, H, W], sRGB in [0, 1], H and W multiples of `stride`.

        Raises:
            ValueError: if the shape is another.
        """
        if pictures.ndim != 4 or pictures.shape[1] != 3 or any(side % self.stride for side in pictures.shape[2:]):
            wanted = f"[N, 3, H, W] with H and W multiples of {self.stride}"
            raise ValueError(f"pictures must be {wanted}, got {list(pictures.shape)}")
        return self.predict(pictures)

    def index(self, name: str) -> int:
        """The label of a class.

        Raises:
            UserError: if the detector knows no such class.
        """
        if name not in self.names:
            raise UserError(unknown(f"class {name!r}", name, self.names))
        return self.names.index(name)


class Scenes(ABC):
    """Frames of a camera world, each with a sign that a patch can be stuck on.

    A patch is [3, P, P] sRGB in [0, 1], its first row the top, P from 8 to 512 texels; it covers a square in the middle of the
    sign's face, whose side is `share` of the sign's.
    """

    size: tuple[int, int]
    """Height and width of every frame in pixels."""
    boxes: Tensor
    """[M, 4] the sign in each frame, clipped to the picture, in pixels."""
    visible: Tensor
    """[M] share of the sign that is in the picture and not hidden, in [0, 1]."""
    distance: Tensor
    """[M] from the camera to the sign along the road, in m."""

    def __len__(self) -> int:
        return len(self.boxes)

    def objects(self, frame: int) -> Objects:
        """What a detector that is trained on a frame should find in it: the sign, unless a world knows more."""
        return Objects(self.boxes[frame : frame + 1], (STOP_SIGN,))

    @abstractmethod
    def render(self, frames: Tensor, patches: Tensor | None, share: float) -> Tensor:
        """Pictures [N, 3, H, W] sRGB in [0, 1], differentiable to the patches.

        Args:
            frames: int64 [N], which frames.
            patches: [N, 3, P, P], or [1, 3, P, P] for the same in all; None leaves the sign as it is.
            share: side of the patch in shares of the sign's, in (0, 1].
        """

    def windows(
        self, frames: Tensor, patches: Tensor | None, share: float, corners: Tensor, size: tuple[int, int]
    ) -> Tensor:
        """Parts [N, 3, h, w] of the pictures that `render` gives; a world that renders no more than these is faster.

        Args:
            frames, patches, share: as of `render`.
            corners: int64 [N, 2], column and row of the first pixel of each.
            size: height and width; every window is within its picture.
        """
        height, width = size
        pictures = self.render(frames, patches, share)
        cut = [p[:, y : y + height, x : x + width] for p, (x, y) in zip(pictures, corners.tolist(), strict=True)]
        return torch.stack(cut)

    def reach(self, share: float) -> Tensor:
        """[M, 4] boxes around all that a patch changes: the sign's, unless a world knows a smaller or needs a larger one."""
        return self.boxes


@dataclass(frozen=True)
class Approach:
    """A drive up to one stop sign, the sign's face as it is until a patch is rendered onto it.

    Args:
        seed: scenario seed.
        location: name of the place.
        scenes: its frames, farthest first, in the order they are driven through.
    """

    seed: int
    location: str
    scenes: Scenes


class CameraWorld(World):
    """Streets with a stop sign, rendered. What is scored is never shown to anyone who crafts or trains."""

    track: ClassVar[Track] = "detection"
    locations: ClassVar[tuple[str, ...]]
    """Names of the places; scenario seed s is driven at `locations[s % len(locations)]`."""
    classes: ClassVar[tuple[str, ...]] = (STOP_SIGN,)
    """Of what there is to find in its scenes (`Scenes.objects`)."""

    @abstractmethod
    def training_scenes(self) -> Scenes:
        """All that crafting a patch or hardening a detector may look at."""

    @abstractmethod
    def approaches(self, cell: Cell, seeds: range) -> list[Approach]:
        """One held-out approach a seed, all of the same number of frames.

        Args:
            cell: lanes (how far the sign stands from the ego's), traffic density (cars, which may hide it), weather.
            seeds: scenario seeds.
        """

    def render(self, out: Path | None, progress: Progress) -> list[Path]:
        """Make the frames of this world anew, going on where it was broken off, and return the files.

        Args:
            out: folder for them; None for the world's own.
            progress: called with the share done and what is being rendered.
        """
        raise NotImplementedError(f"{type(self).__name__} has nothing to render")


class DetectorVictim(Victim):
    """A kind of detector; the fields of the dataclass are its parameters."""

    track: ClassVar[Track] = "detection"
    seeded: ClassVar[bool] = False
    """Whether `load` gives another detector for another seed; one that does not leaves the seeds of a run to the patches."""

    @abstractmethod
    def load(self, seed: int) -> Detector:
        """The detector of training seed `seed`, in eval mode, without gradients on its weights.

        Raises:
            UserError: if its weights are not there or not what they should be.
        """

    def train(self, world: CameraWorld, *, seed: int, progress: Progress) -> Trained[Detector]:
        """Train a detector on the training scenes of a world."""
        raise NotImplementedError(f"{type(self).__name__} does not learn")


class DetectorDefense(Defense):
    """Protects a detector. `train(victim, world, seed, progress)` may look at `world.training_scenes()` only."""

    track: ClassVar[Track] = "detection"

    @abstractmethod
    def load(self, victim: DetectorVictim, seed: int) -> Detector:
        """The defended detector: hardened, from the zoo, or one that transforms the pictures first.

        A transformation without a useful gradient should have a straight-through one (Athalye et al. 2018): an attack that
        runs into a wall by accident proves nothing.
        """


class PatchAttack(Attack):
    """Makes a patch for the middle of the sign, once, from training scenes; it is scored on approaches it never saw."""

    track: ClassVar[Track] = "detection"
    seeded: ClassVar[bool] = True
    """Whether its patch depends on the patch seed; one that does not is crafted for one seed only."""

    @abstractmethod
    def craft(self, oracle: VisionOracle, scenes: Scenes, progress: Progress) -> Tensor | None:
        """The patch [3, P, P] sRGB in [0, 1], P from 8 to 512; None leaves the sign alone.

        Its width is `oracle.threat.budget` times the sign's: what `scenes.render` takes as `share`.

        Args:
            oracle: the only door to the detector; it holds the label to hide (`label`), the query budget (`remaining`) and the
                random generator (`generator`), and can be shown how the patch comes about (`report`).
            scenes: to craft on.
            progress: told how far it is.
        """


def overlap(a: Tensor, b: Tensor) -> Tensor:
    """Intersection over union of boxes [..., 4] and [..., 4], broadcast, in [0, 1]; 0 where neither has an area."""
    low, high = torch.maximum(a[..., :2], b[..., :2]), torch.minimum(a[..., 2:], b[..., 2:])
    intersection = (high - low).clamp(min=0).prod(-1)
    union = _area(a) + _area(b) - intersection
    return intersection / union.clamp(min=torch.finfo(union.dtype).tiny)


def _area(boxes: Tensor) -> Tensor:
    return (boxes[..., 2:] - boxes[..., :2]).prod(-1)


@torch.no_grad()
def detections(predictions: Predictions, *, threshold: float, iou: float) -> list[Detections]:
    """The objects in each picture, after greedy non-maximum suppression within each class.

    A box may be found as more than one class. The time grows with the number of boxes kept, so with a falling threshold.

    Args:
        predictions: of N pictures.
        threshold: a score must be above it, in [0, 1].
        iou: a box that overlaps a better one of its class by more than this is dropped, in [0, 1].
    """
    return [
        _suppressed(boxes, scores, threshold, iou)
        for boxes, scores in zip(predictions.boxes, predictions.scores, strict=True)
    ]


def _suppressed(boxes: Tensor, scores: Tensor, threshold: float, iou: float) -> Detections:
    """Of one picture: boxes [K, 4], scores [K, C]."""
    place, labels = (scores > threshold).nonzero(as_tuple=True)
    order = scores[place, labels].argsort(descending=True, stable=True)
    place, labels = place[order], labels[order]
    kept, left = [], torch.arange(len(place), device=boxes.device)
    while len(left):
        best, left = left[0], left[1:]
        kept.append(best)
        covered = overlap(boxes[place[best]], boxes[place[left]]) > iou
        left = left[~covered | (labels[left] != labels[best])]
    chosen = torch.stack(kept) if kept else left
    place, labels = place[chosen], labels[chosen]
    return Detections(boxes[place], scores[place, labels], labels)


@torch.no_grad()
def confidence(predictions: Predictions, label: int, boxes: Tensor, *, iou: float = 0.3) -> Tensor:
    """The best score [N] of a class at the object's true place; 0 where no prediction lies there.

    The default of `iou` is that of a box moved by half its width: what YOLOv3-tiny says of a stop sign that nobody attacks
    overlaps it by 0.75 and more, and an attack shall make the sign go away, not nudge its box.

    Args:
        predictions: of N pictures.
        label: of the class.
        boxes: [N, 4], the true box in each picture.
        iou: how much a prediction must overlap the true box to count.
    """
    there = overlap(predictions.boxes, boxes.unsqueeze(1)) >= iou
    scores = predictions.scores_of(label) * there
    return nn.functional.pad(scores, (0, 1)).amax(-1)
