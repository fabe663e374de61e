"""The training losses of detectors, compared with known values."""

from __future__ import annotations

import torch
from torch import Tensor

from cavbench.detection import Predictions
from cavbench.detection.boxes import detections
from cavbench.detection.victims.loss import complete_overlap, missed, mistaken, supervised, unlike

BOXES = torch.tensor([[10.0, 10.0, 40.0, 40.0], [50.0, 20.0, 70.0, 60.0]])
LABELS = torch.tensor([1, 0])


class Grid:
    """A detector without a network: 8 x 8 cells of a picture of 80 pixels, a raw box, objectness and two classes in each."""

    def __init__(self) -> None:
        self.raw = torch.zeros(1, 64, 7)
        self.raw[..., 4] = -4.0
        self.raw.requires_grad_(True)
        cell = torch.arange(8) * 10.0 + 5
        self.centres = torch.stack(torch.meshgrid(cell, cell, indexing="xy"), -1).reshape(1, 64, 2)

    def predict(self) -> Predictions:
        middle = self.centres + 10 * self.raw[..., :2].tanh()
        half = 10 * self.raw[..., 2:4].exp()
        boxes = torch.cat((middle - half, middle + half), -1)
        return Predictions(boxes, self.raw[..., 4].sigmoid(), self.raw[..., 5:].sigmoid())


def test_descending_finds_every_object_and_nothing_else() -> None:
    grid = Grid()
    adam = torch.optim.Adam([grid.raw], lr=0.1)
    for _ in range(200):
        adam.zero_grad()
        supervised(grid.predict(), [BOXES], [LABELS]).backward()
        adam.step()
    (found,) = detections(grid.predict(), threshold=0.5, iou=0.5)
    assert sorted(found.labels.tolist()) == [0, 1]
    for box, label in zip(found.boxes, found.labels, strict=True):
        torch.testing.assert_close(box, BOXES[label == LABELS][0], atol=2.0, rtol=0)
    assert found.scores.min() > 0.8


def test_an_image_without_objects_has_no_targets() -> None:
    grid = Grid()
    supervised(grid.predict(), [torch.zeros(0, 4)], [torch.zeros(0, dtype=torch.int64)]).backward()
    assert grid.raw.grad is not None
    assert (grid.raw.grad[..., 4] > 0).all()
    assert not grid.raw.grad[..., :4].any()


def test_unlike_is_zero_for_equal_predictions_and_positive_for_any_change() -> None:
    drawn = torch.Generator().manual_seed(0)
    grid = Grid()
    teacher = grid.predict()
    assert abs(float(unlike(teacher, teacher).detach())) < 1e-4
    for part in (slice(0, 4), slice(4, 5), slice(5, 7)):
        other = Grid()
        with torch.no_grad():
            change = other.raw[..., part]
            change += torch.rand(change.shape, generator=drawn) + 0.5
        assert unlike(other.predict(), teacher) > 0.05


def predicted(score: float, box: Tensor) -> Predictions:
    return Predictions(box[None, None], torch.full((1, 1), score), torch.ones(1, 1, 2))


def test_a_detection_elsewhere_counts_as_missed() -> None:
    there, away = BOXES[0], BOXES[0] + 25
    assert missed(predicted(1.0, there), 1, BOXES[:1]).item() == 0
    assert missed(predicted(0.5, there), 1, BOXES[:1]).item() == torch.tensor(2.0).log()
    assert missed(predicted(1.0, away), 1, BOXES[:1]) > 9


def test_a_detection_is_mistaken_unless_it_is_on_the_object() -> None:
    here, present = BOXES[:1], torch.tensor([True])
    assert mistaken(predicted(0.9, here[0]), 1, here, present).item() == 0
    for box, there in ((here[0] + 35, present), (here[0], ~present)):
        assert torch.isclose(mistaken(predicted(0.75, box), 1, here, there), torch.tensor([4.0]).log())


def test_complete_overlap_is_one_for_a_box_itself_and_falls_with_distance_and_shape() -> None:
    box = BOXES[:1]
    assert complete_overlap(box, box).item() == 1
    near, far = complete_overlap(box + 60, box), complete_overlap(box + 200, box)
    assert 0 > near > far > -1
    wide = box + torch.tensor([[-10.0, 5.0, 10.0, -5.0]])
    assert complete_overlap(wide, box) < complete_overlap(box * 1.0 + torch.tensor([[0.0, 0.0, 10.0, 0.0]]), box) < 1
