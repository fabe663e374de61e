"""Rules for the detectors of victims and defences."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from cavbench.checks.check import Check, Suite, require
from cavbench.checks.network import check_frozen, check_gradient, check_white_box, unchanged
from cavbench.detection import STOP_SIGN, Detector, Predictions
from cavbench.detection.checks.street import Street
from cavbench.isolation.memory import changed, kept

PICTURES = 3


class DetectorSuite(Suite):
    """Checks of the detector of a `DetectorVictim` or a `DetectorDefense`."""

    def checks(self) -> Mapping[str, Check]:
        return {
            "ready to look": self.frozen,
            "shape and range": self.predicts,
            "batching": self.neighbours_do_not_matter,
            "determinism": self.same_picture_same_answer,
            "sees": self.looks,
            "memory": self.remembers,
            "gradient": self.differentiable,
            "weights left alone": self.keeps_weights,
        }

    def frozen(self) -> None:
        """The detector is in eval mode, has weights without gradients, and a stop sign among its classes."""
        detector = self.subject.load()
        require(
            isinstance(detector, Detector),
            f"load returned a {type(detector).__name__}, not a cavbench.detection.Detector",
        )
        check_frozen(detector, "detector")
        require(STOP_SIGN in detector.names, f"none of its classes is {STOP_SIGN!r}, which attacks hide")
        require(isinstance(detector.stride, int) and detector.stride > 0, "stride must be a whole number of pixels")

    def predicts(self) -> None:
        """Predictions have the shapes and ranges of `Predictions`."""
        detector, pictures = self.subject.load(), self._pictures()
        found = detector(pictures)
        boxes, objectness, classes = found.boxes, found.objectness, found.classes
        count = boxes.shape[1]
        wanted = ((PICTURES, count, 4), (PICTURES, count), (PICTURES, count, len(detector.names)))
        shapes = tuple(tuple(part.shape) for part in (boxes, objectness, classes))
        require(shapes == wanted, f"boxes, objectness and classes are {shapes}, not {wanted}")
        require(bool(boxes.isfinite().all()), "some boxes are NaN or infinite")
        require(
            bool((boxes[..., 2:] >= boxes[..., :2]).all()),
            "some boxes have x2 < x1 or y2 < y1: return [x1, y1, x2, y2]",
        )
        for name, part in (("objectness", objectness), ("classes", classes)):
            require(bool(((part >= 0) & (part <= 1)).all()), f"{name} has values outside [0, 1]: return probabilities")

    def neighbours_do_not_matter(self) -> None:
        """Predictions for an image do not depend on the others of its batch."""
        detector, among = self.subject.load(), self._pictures()
        others = among.flip(0).clone()
        others[0] = among[0]
        first, second = detector(among).scores[0], detector(others).scores[0]
        require(
            torch.allclose(first, second, rtol=1e-3, atol=1e-5),
            "its predictions for an image depend on the others of the batch: is a batch normalisation in training mode?",
        )

    def same_picture_same_answer(self) -> None:
        """Two loads and two calls give the same predictions."""
        pictures, detector = self._pictures(), self.subject.load()
        first, before = detector(pictures).scores, kept(detector)
        detector(pictures.flip(0))
        left = changed(before, kept(detector))
        require(not left, f"it remembers earlier images in {left}: return what is remembered (initial and advance)")
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(1)
            second, again = detector(pictures).scores, self.subject.load()(pictures).scores
        require(
            torch.equal(first, second),
            "two calls with the same image give different predictions: predict must have no side effect and no randomness",
        )
        require(
            torch.equal(first, again),
            "two loads with the same seed give different predictions: derive the weights from the seed only",
        )

    def looks(self) -> None:
        """Predictions depend on the image."""
        scores = self.subject.load()(self._pictures()).scores
        require(
            not torch.equal(scores[0], scores[1]),
            "its predictions are the same for two different images: does predict use its input?",
        )

    def differentiable(self) -> None:
        """Scores have a gradient with respect to the pixels, which white-box attacks need."""
        check_white_box(self.subject.victim)
        leaf, detector = self._pictures().requires_grad_(True), self.subject.load()
        scores = detector(leaf).scores_of(detector.index(STOP_SIGN))
        require(scores.requires_grad, "its scores have no graph: do not use torch.no_grad, .detach or NumPy in predict")
        (gradient,) = torch.autograd.grad(scores.sum(), leaf)
        check_gradient(gradient)

    def remembers(self) -> str:
        """The frames of an approach are reported one by one as at once, and what is remembered is a value."""
        detector = self.subject.load()
        found, moved = detector(self._pictures()), torch.tensor([0.0, 1.0, 1.0])
        label = detector.index(STOP_SIGN)

        def best(predictions: Predictions) -> Tensor:
            return predictions.scores_of(label).amax(-1)

        start = detector.initial()
        together, _ = detector.advance(found, moved, start)
        state, parts = start, []
        for number in range(PICTURES):
            one = slice(number, number + 1)
            frame = Predictions(found.boxes[one], found.objectness[one], found.classes[one])
            part, state = detector.advance(frame, moved[one], state)
            parts.append(best(part))
        again, _ = detector.advance(found, moved, start)
        require(torch.allclose(torch.cat(parts), best(together), atol=1e-5), "frames one by one are reported otherwise")
        require(torch.equal(best(again), best(together)), "advance has a side effect: return what is remembered")
        scores = best(found).detach().requires_grad_(True)
        reported = detector.aggregate(scores)
        require(reported.shape == scores.shape, "aggregate must return one score for each frame")
        (gradient,) = torch.autograd.grad(reported.sum(), scores)
        require(bool((gradient != 0).all()), "a frame's score has no gradient through aggregate")
        return "none" if together is found else "frames add up"

    def keeps_weights(self) -> None:
        """Loading and calling it changes neither weights nor images."""
        detector, pictures = self.subject.load(), self._pictures()
        shown = pictures.clone()
        with unchanged(detector, self.subject.load_victim):
            detector(pictures)
            self.subject.load()
        require(torch.equal(pictures, shown), "the images were changed in place: work on a copy")

    def _pictures(self) -> Tensor:
        """Three images of the street with random noise, padded to a multiple of the stride."""
        scenes, stride = Street(), self.subject.load().stride
        pictures = scenes.render(torch.arange(PICTURES), None, 1.0)
        side = -(-max(scenes.size) // stride) * stride
        noise = torch.rand(PICTURES, 3, side, side, generator=torch.Generator().manual_seed(0))
        wide = torch.nn.functional.pad(pictures, (0, side - scenes.size[1], 0, side - scenes.size[0]), value=0.5)
        return 0.8 * wide + 0.2 * noise
