"""The rules for detectors, of victims and of defences."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from bench.conformance.check import Check, Suite, require
from bench.conformance.detection.street import Street
from bench.conformance.network import check_frozen, check_gradient, check_white_box, unchanged
from bench.detection import STOP_SIGN, Detector

PICTURES = 3


class DetectorSuite(Suite):
    """Of what a `DetectorVictim` or a `DetectorDefense` loads."""

    def checks(self) -> Mapping[str, Check]:
        return {
            "ready to look": self.frozen,
            "shape and range": self.predicts,
            "batching": self.neighbours_do_not_matter,
            "determinism": self.same_picture_same_answer,
            "sees": self.looks,
            "gradient": self.differentiable,
            "weights left alone": self.keeps_weights,
        }

    def frozen(self) -> None:
        """Eval mode, no gradients on weights, and a stop sign among its classes."""
        detector = self.subject.load()
        require(
            isinstance(detector, Detector),
            f"load returned a {type(detector).__name__}, not a bench.detection.Detector",
        )
        check_frozen(detector, "detector")
        require(STOP_SIGN in detector.names, f"none of its classes is {STOP_SIGN!r}, which is what attacks hide")
        require(isinstance(detector.stride, int) and detector.stride > 0, "stride must be a whole number of pixels")

    def predicts(self) -> None:
        """Boxes and probabilities of the shapes and ranges that `Predictions` says."""
        detector, pictures = self.subject.load(), self._pictures()
        found = detector(pictures)
        boxes, objectness, classes = found.boxes, found.objectness, found.classes
        count = boxes.shape[1]
        wanted = ((PICTURES, count, 4), (PICTURES, count), (PICTURES, count, len(detector.names)))
        shapes = tuple(tuple(part.shape) for part in (boxes, objectness, classes))
        require(shapes == wanted, f"boxes, objectness and classes are {shapes}, not {wanted}")
        require(bool(boxes.isfinite().all()), "some boxes are NaN or infinite")
        require(bool((boxes[..., 2:] >= boxes[..., :2]).all()), "some boxes end before they begin: [x1, y1, x2, y2]")
        for name, part in (("objectness", objectness), ("classes", classes)):
            require(
                bool(((part >= 0) & (part <= 1)).all()), f"{name} has numbers outside [0, 1]: they are probabilities"
            )

    def neighbours_do_not_matter(self) -> None:
        """Every picture of a batch is looked at by itself."""
        detector, among = self.subject.load(), self._pictures()
        others = among.flip(0).clone()
        others[0] = among[0]
        first, second = detector(among).scores[0], detector(others).scores[0]
        require(
            torch.allclose(first, second, rtol=1e-3, atol=1e-5),
            "its predictions for a picture change with the others of the batch: is a batch normalisation in training mode?",
        )

    def same_picture_same_answer(self) -> None:
        """Loaded twice and asked twice, it says the same."""
        pictures, detector = self._pictures(), self.subject.load()
        first = detector(pictures).scores
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(1)
            second, again = detector(pictures).scores, self.subject.load()(pictures).scores
        require(
            torch.equal(first, second),
            "asked twice about a picture, it gives two answers: predict must have no side effect and draw nothing",
        )
        require(
            torch.equal(first, again),
            "two loads with the same seed predict differently: make weights from the seed only",
        )

    def looks(self) -> None:
        """What it says depends on the picture."""
        scores = self.subject.load()(self._pictures()).scores
        require(
            not torch.equal(scores[0], scores[1]),
            "its predictions are the same for two different pictures: does predict use its input?",
        )

    def differentiable(self) -> None:
        """White-box attacks find a way back to the pixels."""
        check_white_box(self.subject.victim)
        leaf, detector = self._pictures().requires_grad_(True), self.subject.load()
        scores = detector(leaf).scores_of(detector.index(STOP_SIGN))
        require(scores.requires_grad, "its scores have no graph: no torch.no_grad in predict, no .detach, no NumPy")
        (gradient,) = torch.autograd.grad(scores.sum(), leaf)
        check_gradient(gradient)

    def keeps_weights(self) -> None:
        """Loading and asking change nothing."""
        detector, pictures = self.subject.load(), self._pictures()
        shown = pictures.clone()
        with unchanged(detector, self.subject.load_victim):
            detector(pictures)
            self.subject.load()
        require(torch.equal(pictures, shown), "the pictures were changed in place")

    def _pictures(self) -> Tensor:
        """Three of the street with a random veil, padded to what the stride needs."""
        scenes, stride = Street(), self.subject.load().stride
        pictures = scenes.render(torch.arange(PICTURES), None, 1.0)
        side = -(-max(scenes.size) // stride) * stride
        veil = torch.rand(PICTURES, 3, side, side, generator=torch.Generator().manual_seed(0))
        wide = torch.nn.functional.pad(pictures, (0, side - scenes.size[1], 0, side - scenes.size[0]), value=0.5)
        return 0.8 * wide + 0.2 * veil
