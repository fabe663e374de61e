"""From predictions to detections: overlap, non-maximum suppression, and the confidence at an object's true place."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from cavbench.detection import Detector, Predictions
from cavbench.detection.boxes import confidence, detections, overlap
from cavbench.errors import UserError

relaxed = settings(deadline=None)
LENGTH = st.integers(0, 12)


@st.composite
def predictions(draw: st.DrawFn, pictures: int = 1) -> Predictions:
    """A few small boxes close together, so that many overlap, with scores that all differ."""
    count, classes = draw(st.integers(0, 12)), draw(st.integers(1, 3))
    rows = draw(st.lists(st.tuples(*[LENGTH] * 4), min_size=pictures * count, max_size=pictures * count))
    corner_and_size = torch.tensor(rows, dtype=torch.float32).reshape(pictures, count, 4)
    boxes = torch.cat((corner_and_size[..., :2], corner_and_size[..., :2] + corner_and_size[..., 2:]), -1)
    cells = pictures * count * classes
    ranks = torch.tensor(draw(st.permutations(range(cells))), dtype=torch.float32)
    scores = ((ranks + 0.5) / max(cells, 1)).reshape(pictures, count, classes)
    return Predictions(boxes, torch.ones(pictures, count), scores)


def area_shared(a: list[float], b: list[float]) -> float:
    """Intersection over union by the definition."""
    width, height = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    shared = max(width, 0) * max(height, 0)
    both = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - shared
    return shared / both if both else 0.0


def by_hand(boxes: Tensor, scores: Tensor, threshold: float, iou: float) -> list[tuple[list[float], float, int]]:
    """Non-maximum suppression, class by class, without a tensor."""
    found = []
    for label in range(scores.shape[1]):
        ranked = sorted(zip(scores[:, label].tolist(), boxes.tolist(), strict=True), reverse=True)
        kept: list[list[float]] = []
        for score, box in ranked:
            if score > threshold and all(area_shared(box, better) <= iou for better in kept):
                kept.append(box)
                found.append((box, score, label))
    return sorted(found, key=lambda one: -one[1])


@relaxed
@given(predictions(pictures=2), st.sampled_from([0.0, 0.3, 0.9]), st.sampled_from([0.0, 0.31, 0.7, 1.0]))
def test_suppression_matches_the_definition(given: Predictions, threshold: float, iou: float) -> None:
    found = detections(given, threshold=threshold, iou=iou)
    for one, boxes, scores in zip(found, given.boxes, given.scores, strict=True):
        got = list(zip(one.boxes.tolist(), one.scores.tolist(), one.labels.tolist(), strict=True))
        assert got == by_hand(boxes, scores, threshold, iou)


@relaxed
@given(predictions(), st.randoms(use_true_random=False))
def test_the_order_of_the_predictions_does_not_matter(given: Predictions, random) -> None:
    order = list(range(given.boxes.shape[1]))
    random.shuffle(order)
    shuffled = Predictions(given.boxes[:, order], given.objectness[:, order], given.classes[:, order])
    (one,), (other,) = (detections(each, threshold=0.2, iou=0.4) for each in (given, shuffled))
    for name in ("boxes", "scores", "labels"):
        assert torch.equal(getattr(one, name), getattr(other, name))


def test_two_classes_at_one_place_are_both_found() -> None:
    same = torch.tensor([[[0.0, 0, 10, 10], [0, 0, 10, 10]]])
    scores = torch.tensor([[[0.9, 0.0], [0.8, 0.7]]])
    (found,) = detections(Predictions(same, torch.ones(1, 2), scores), threshold=0.5, iou=0.5)
    assert found.labels.tolist() == [0, 1]


@relaxed
@given(st.tuples(*[LENGTH] * 4), st.tuples(*[LENGTH] * 4))
def test_overlap_matches_the_definition(a: tuple[int, ...], b: tuple[int, ...]) -> None:
    boxes = [[x, y, x + width, y + height] for x, y, width, height in (a, b)]
    got = overlap(*(torch.tensor(box, dtype=torch.float32) for box in boxes)).item()
    assert got == pytest.approx(area_shared(*boxes))


@relaxed
@given(predictions(pictures=3), st.sampled_from([0.1, 0.3, 0.8]), st.tuples(*[LENGTH] * 4))
def test_confidence_is_the_best_score_at_the_true_place(given: Predictions, iou: float, true: tuple[int, ...]) -> None:
    x, y, width, height = true
    box = [x, y, x + width, y + height]
    got = confidence(given, 0, torch.tensor(box, dtype=torch.float32).expand(3, 4), iou=iou)
    for best, boxes, scores in zip(got.tolist(), given.boxes.tolist(), given.scores[..., 0].tolist(), strict=True):
        there = [score for one, score in zip(boxes, scores, strict=True) if area_shared(one, box) >= iou]
        assert best == pytest.approx(max(there, default=0.0))


class Blank(Detector):
    """A detector that detects nothing."""

    names = ("car", "stop sign")
    stride = 32

    def predict(self, pictures: Tensor) -> Predictions:
        nothing = pictures.new_zeros(len(pictures), 0, 4)
        return Predictions(nothing, nothing[..., 0], nothing[..., :2])


@pytest.mark.parametrize("shape", [(3, 64, 64), (1, 1, 64, 64), (1, 3, 64, 65), (1, 3, 33, 64)])
def test_an_image_of_a_wrong_shape_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="multiples of 32, got"):
        Blank()(torch.zeros(shape))


def test_a_class_is_found_by_its_name() -> None:
    assert Blank().index("stop sign") == 1
    with pytest.raises(UserError, match=r"unknown class 'stopsign'; did you mean 'stop sign'\?"):
        Blank().index("stopsign")


def test_the_best_hundred_objects_of_an_image_are_kept() -> None:
    corners = torch.arange(150.0).mul(20)
    boxes = torch.stack((corners, corners, corners + 10, corners + 10), -1)
    scores = torch.linspace(0.1, 0.9, 150)
    (found,) = detections(Predictions(boxes[None], torch.ones(1, 150), scores[None, :, None]), threshold=0.01, iou=0.45)
    assert torch.equal(found.scores, scores.flip(0)[:100])
