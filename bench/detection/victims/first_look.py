"""Tries the network of a detector of others on three images, before it is used: it must be read as it is meant."""

from __future__ import annotations

import torch
from torch import Tensor

from cavbench.detection.sight import LEAST_SCORE
from cavbench.detection.victims import layout
from cavbench.detection.victims.file_network import FileDetector
from cavbench.detection.victims.reading import Foreign
from cavbench.errors import UserError

SIDE = 320
"""Side in pixels of the images on which a network is tried: the window of `eot`."""
TOLERANCE = {torch.float32: 1e-4, torch.float16: 1e-2, torch.uint8: 1e-4}
"""By so much may scores be outside of [0, 1] or depend on the batch, from rounding."""
SMALL, LARGE = 2.0, 10.0
"""Boxes in pixels reach beyond the first; boxes in shares of the image stay below the second."""
INVERTED = 0.25, 0.5
"""From these shares of inverted boxes on their form is another one: of those that are kept; and of all if none is kept."""


def look(victim: Foreign, detector: FileDetector) -> Tensor | None:
    """Try a detector on noise, a white image and a grey one, and set its class names if they follow from its outputs.

    Args:
        victim: how it is read.
        detector: as it is read; without class names if they were not given.

    Returns:
        The gradient of its scores in the pixels of an image; None if the scores do not come from the pixels by operations that
        have one.

    Raises:
        UserError: if it fails, or its predictions are not those of a detector.
    """
    pictures = torch.rand(3, 3, SIDE, SIDE, generator=torch.Generator().manual_seed(0))
    pictures[1], pictures[2] = 1.0, 0.5
    with torch.no_grad():
        if not detector.names or victim.activation == "softmax":
            shapes = [one.shape for one in detector.outputs_for(pictures[:1])]
            detector.names = layout.with_no_object(detector.names, shapes) if detector.names else layout.named(shapes)
        alone, grey, together = detector.raw(pictures[:1]), detector.raw(pictures[2:]), detector.raw(pictures)
    boxes, objectness, classes, *_ = together
    path, tolerance = detector.path, TOLERANCE[detector.given.dtype]
    if victim.fixed and len({alone[0].shape, grey[0].shape, boxes[:1].shape}) > 1:
        raise UserError(
            f"{path} returns {alone[0].shape[1]} boxes for one image and {grey[0].shape[1]} for another: export it without "
            "non-maximum suppression, with a fixed number of boxes"
        )
    if not all(bool(part.isfinite().all()) for part in (*alone[:3], boxes, objectness, classes)):
        raise UserError(f"{path} returns boxes or scores that are NaN or infinite")
    if found := [*_scores(victim, objectness, classes, tolerance), *_boxes(victim, *together)]:
        what, words = (" and ".join(part) for part in zip(*found, strict=True))
        raise UserError(f"{path} returns {what}: {words}")
    count = min(alone[0].shape[1], boxes.shape[1])
    first, among = ((part[1][0, :, None] * part[2][0]).topk(count, 0).values for part in (alone, together))
    if not torch.allclose(first, among, rtol=tolerance, atol=tolerance):
        raise UserError(
            f"{path} returns other scores for an image if other images are in its batch: export it in eval mode"
        )
    return _gradient(detector, pictures[:1])


def _scores(victim: Foreign, objectness: Tensor, classes: Tensor, tolerance: float) -> list[tuple[str, str]]:
    """What is wrong with the scores, and what to type."""
    low, high = min(float(objectness.min()), float(classes.min())), max(float(objectness.max()), float(classes.max()))
    if low >= -tolerance and high <= 1 + tolerance:
        return []
    what = f"scores between {low:.3g} and {high:.3g}, they must be in [0, 1]"
    meant = f"if they are logits, set {victim.said('activation', 'sigmoid')} or {victim.said('activation', 'softmax')}"
    return [(what, meant)]


def _boxes(
    victim: Foreign, boxes: Tensor, objectness: Tensor, classes: Tensor, shift: Tensor, scale: Tensor
) -> list[tuple[str, str]]:
    """In which other way boxes are written than the parameters say, and what to type."""
    found = []
    inverted = (boxes[..., 2:] < boxes[..., :2]).any(-1)
    sure = objectness * classes.amax(-1)
    # Of logits, too, so that both complaints stand in one line.
    kept = (sure.sigmoid() if float(sure.min()) < 0 else sure) > LEAST_SCORE
    share = float(inverted[kept].float().mean()) if bool(kept.any()) else float(inverted.float().mean())
    if share >= INVERTED[0 if bool(kept.any()) else 1]:
        other = "leave out " if victim.boxes == "centre" else "if they are [x, y, width, height], set "
        found.append(("boxes with x2 < x1 or y2 < y1", f"{other}{victim.said('boxes', 'centre')}"))
    largest = float(boxes.abs().max())
    if not victim.normalised and 0 < largest <= SMALL:
        found.append((f"boxes whose coordinates are at most {largest:.3g}", f"set {victim.said('normalised', True)}"))
    if victim.normalised and largest > LARGE * float((SIDE * scale + 2 * shift).max()):
        found.append(("boxes far beyond the image", f"leave out {victim.said('normalised', True)}"))
    return found


def _gradient(detector: FileDetector, picture: Tensor) -> Tensor | None:
    """The gradient of the scores in the pixels; None for scores without one.

    Raises:
        UserError: if it is NaN or infinite.
    """
    leaf = picture.clone().requires_grad_()
    scores = detector(leaf).scores
    try:
        (gradient,) = torch.autograd.grad(scores.sum(), leaf)
    except RuntimeError:
        return None
    if not bool(gradient.isfinite().all()):
        raise UserError(f"{detector.path} has a gradient from its scores to the pixels that is NaN or infinite")
    return gradient
