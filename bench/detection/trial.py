"""Tries a detector on frames of its world before a run."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cavbench.core.contracts import Facts
from cavbench.detection import STOP_SIGN, CameraWorld, Detector, DetectorVictim, Predictions, Scenes
from cavbench.detection.boxes import best_other, confidence
from cavbench.errors import UserError, reason
from cavbench.isolation.memory import changed, kept
from cavbench.isolation.streams import Stream

WINDOW = 320
"""Side in pixels of the windows around the sign."""
FRAMES = 4
"""Windows, from the nearest sign to one of average size."""
VISIBLE = 0.9
"""Share of the sign that is in the picture and not hidden."""
SURE, SEES, BLIND = 0.8, 0.25, 0.05
"""Mean confidences in near signs: of a good detector; from which on it sees them; and below which it does not."""
SURER = 0.2
"""With other parameters it is far surer: by so much, or by half of what is missing."""
TOLERANCE = 1e-3
"""Scores may depend on the batch by so much, from rounding."""


@dataclass(frozen=True)
class Windows:
    """Windows of clear training frames with a sign.

    Args:
        pictures: [N, 3, H, W].
        boxes: [N, 4] the sign's.
    """

    pictures: Tensor
    boxes: Tensor

    @classmethod
    def of(cls, scenes: Scenes, stride: int) -> Windows:
        """Those of the nearest sign and of smaller ones, in the order of their size."""
        seen = (scenes.visible >= VISIBLE).nonzero().squeeze(1)
        sizes = (scenes.boxes[seen, 2] - scenes.boxes[seen, 0]).argsort(descending=True)
        frames = seen[sizes[torch.linspace(0, len(seen) // 2, FRAMES).long()]]
        size = tuple(min(WINDOW, side) // stride * stride or side for side in scenes.size)
        limit = torch.tensor([scenes.size[1] - size[1], scenes.size[0] - size[0]])
        middle = (scenes.boxes[frames, :2] + scenes.boxes[frames, 2:]) / 2
        corners = torch.minimum((middle - torch.tensor([size[1], size[0]]) / 2).round().long().clamp(min=0), limit)
        pictures = scenes.windows(frames, None, 1.0, corners, (size[0], size[1]))
        return cls(pictures, scenes.boxes[frames] - corners.repeat(1, 2))


def try_detector(detector: Detector, victim: DetectorVictim, world: CameraWorld, *, alone: bool) -> list[str]:
    """Try what attacks, probes and replays rely on, on clear training frames without a patch.

    Args:
        detector: the (defended) victim, as it is loaded; it is not used afterwards.
        victim: the victim.
        world: the world that it will look at.
        alone: whether it has no defence.

    Returns:
        Warnings, each the end of a sentence that begins with the detector.

    Raises:
        UserError: the end of such a sentence, if its score would be wrong: it answers NaN, depends on the
            rest of the batch, or remembers what it is not given.
    """
    with Stream("trial").in_use():
        windows = Windows.of(world.training_scenes(), detector.stride)
        label = detector.index(STOP_SIGN)
        found = _try_memory(detector, windows, label)
        _try_batches(detector, windows, label, found)
        if doubt := _sight(detector, victim, world.facts, windows, label, alone=alone):
            return [doubt]
        return [] if victim.answers != "gradients" else _gradients(detector, windows, label)


def _predicted(detector: Detector, pictures: Tensor) -> Predictions:
    with torch.no_grad():
        return detector(pictures.clone())


def _best(predictions: Predictions, label: int) -> Tensor:
    """[N] the highest score of a stop sign in each picture."""
    return predictions.scores_of(label).amax(-1)


def _try_memory(detector: Detector, windows: Windows, label: int) -> Tensor:
    """[N] the highest scores.

    Raises:
        UserError: if they are NaN, depend on earlier calls or on random numbers, or a call leaves something behind.
    """
    first = _predicted(detector, windows.pictures)
    parts = (first.boxes, first.objectness, first.classes)
    if any(part.is_complex() or not bool(part.isfinite().all()) for part in parts):
        raise UserError("predicts boxes or scores that are NaN, infinite or complex")
    before = kept(detector)
    _predicted(detector, windows.pictures.flip(0))
    left = changed(before, kept(detector))
    again = _best(_predicted(detector, windows.pictures), label)
    if left:
        raise UserError(
            f"remembers earlier pictures in {left[0]!r}: attacks and probes ask it between two frames, so what it remembers must "
            "be a value of Detector.initial and Detector.advance"
        )
    if not torch.equal(again, _best(first, label)):
        raise UserError(
            "predicts otherwise when it is shown the same again: it remembers earlier pictures, or draws random numbers, so no "
            "score of it could be repeated"
        )
    return again


def _try_batches(detector: Detector, windows: Windows, label: int, found: Tensor) -> None:
    """Raise UserError if the predictions for a picture depend on the others of its batch, or on its place."""
    one = windows.pictures[:1]
    # Other windows are like it, so their statistics are, too.
    others = torch.cat((torch.rand(one.shape, generator=torch.Generator().manual_seed(0)), torch.ones_like(one), one))
    batches = {
        "alone": (one, 0),
        "among other pictures": (others, 2),
        "in another order": (windows.pictures.flip(0), -1),
    }
    for where, (pictures, place) in batches.items():
        if abs(float(_best(_predicted(detector, pictures), label)[place] - found[0])) > TOLERANCE:
            raise UserError(
                f"predicts otherwise for a picture {where}: normalise and quantise by fixed statistics, not by those of the "
                "batch (as quantize_dynamic does), and call eval() before an export"
            )


def _gradients(detector: Detector, windows: Windows, label: int) -> list[str]:
    leaf = windows.pictures[:2].clone().requires_grad_(True)
    gradient = None
    try:
        with torch.enable_grad():
            scores = detector(leaf).scores_of(label)
            if scores.requires_grad:
                (gradient,) = torch.autograd.grad(scores.sum(), leaf, allow_unused=True)
    # The network may raise anything.
    except Exception as error:
        raise UserError(f"fails when an attack asks for its gradient: {reason(error)}") from error
    if gradient is None or not bool(gradient.nan_to_num(0.0, 0.0, 0.0).any()):
        return [
            "has no gradient from its scores to the pixels (rounding, thresholds, detach): attacks with gradients cannot tell "
            "how robust it is; square_patch asks for scores only"
        ]
    if not bool(gradient.isfinite().all()):
        return ["has a gradient with NaN or infinity: attacks with gradients count such a pixel as 0"]
    return []


def _sight(
    detector: Detector, victim: DetectorVictim, facts: Facts, windows: Windows, label: int, *, alone: bool
) -> str:
    """What is wrong if it is not sure of signs without a patch, and how else its file may be meant; empty if it is sure."""
    predictions = _predicted(detector, windows.pictures)
    own = float(confidence(predictions, label, windows.boxes).mean())
    if own >= SURE:
        return ""
    other, named = max(best_other(predictions, label, windows.boxes))
    misnamed = own < SEES and other >= max(SEES, own + SURER)
    hint = _hint(victim, facts, windows, own, ("victim.names=",) if misnamed else ("",)) if alone else ""
    if misnamed and not hint:
        hint = f"it sees {detector.names[named]!r} there: are its class names in its own order?"
    if own >= BLIND and not hint:
        return ""
    seen = "no stop sign" if own < BLIND else f"a stop sign with a mean confidence of {own:.2f}"
    line = f"sees {seen} in {len(windows.pictures)} clear, near frames without a patch"
    return f"{line}; {hint}" if hint else f"{line}, so its score says nothing"


def _hint(victim: DetectorVictim, facts: Facts, windows: Windows, own: float, begins: tuple[str, ...]) -> str:
    """The fewest other parameters, whose words begin so, with which it is far surer of the sign; empty if there are none."""
    others = {words: other for words, other in victim.alternatives().items() if words.startswith(begins)}
    for count in sorted({len(words.split()) for words in others}):
        found = []
        for words in (words for words in others if len(words.split()) == count):
            try:
                network = others[words].load(0, facts)
                predictions = _predicted(network, windows.pictures)
            except UserError:
                continue
            sure = confidence(predictions, network.index(STOP_SIGN), windows.boxes)
            found.append((float(sure.mean()), words))
        best, words = max(found, default=(0.0, ""))
        if best >= max(SEES, own + min(SURER, (1 - own) / 2)):
            return f"with {words} it has {best:.2f}"
    return ""
