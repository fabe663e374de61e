"""The matching of objects with queries, and what the loss of a set of objects wants."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from cavbench.detection.victims import matching
from cavbench.detection.victims.examples import Example
from cavbench.detection.victims.matching import Answer
from cavbench.errors import UserError

SIDE = 128
BOXES = torch.tensor([[30.0, 30, 60, 64], [70, 20, 100, 60], [10, 80, 50, 120]])
LABELS = torch.tensor([0, 1, 1])
QUERIES = 6
ORDER = torch.tensor([4, 0, 3])
"""The query that knows each object."""
NOTHING = -9.0


def example(boxes: Tensor = BOXES, labels: Tensor = LABELS) -> Example:
    return Example(torch.zeros(1, 3, SIDE, SIDE), [boxes], [labels])


@pytest.fixture
def known() -> Answer:
    """One query knows each object, the others find nothing at the same places."""
    boxes, logits = BOXES.repeat(2, 1)[None].clone(), torch.full((1, QUERIES, 2), NOTHING)
    boxes[0, ORDER] = BOXES
    logits[0, ORDER, LABELS] = -NOTHING
    return Answer(boxes, logits)


def pairs(answer: Answer, copies: int = 1) -> dict[int, int]:
    queries, objects = matching.matched(answer.boxes[0], answer.logits[0], BOXES, LABELS, SIDE, copies)
    assert len(set(queries.tolist())) == len(queries), "no query has two objects"
    return dict(zip(queries.tolist(), objects.tolist(), strict=True))


def test_each_object_is_matched_with_the_query_that_knows_it(known: Answer) -> None:
    assert pairs(known) == {4: 0, 0: 1, 3: 2}


def test_of_equal_classes_the_nearer_box_is_matched() -> None:
    near = Answer(BOXES.flip(0)[None] + 3.0, torch.zeros(1, 3, 2))
    assert pairs(near) == {2: 0, 1: 1, 0: 2}


def test_the_cheapest_whole_is_taken_and_not_the_cheapest_pair() -> None:
    # Both objects like the first query best; the second object would have a far one.
    boxes = torch.tensor([[10.0, 10, 40, 40], [20, 10, 50, 40]])
    here = torch.tensor([[14.0, 10, 44, 40], [2, 10, 32, 40]])
    queries, objects = matching.matched(here, torch.zeros(2, 1), boxes, torch.zeros(2, dtype=torch.int64), SIDE, 1)
    assert list(zip(queries.tolist(), objects.tolist(), strict=True)) == [(0, 1), (1, 0)]


def test_a_training_that_has_diverged_ends_with_a_line(known: Answer) -> None:
    known.boxes[0, 0, 0] = torch.nan
    with pytest.raises(UserError, match="its training has diverged: try a lower learning rate"):
        pairs(known)


def test_with_copies_several_queries_learn_an_object(known: Answer) -> None:
    several = list(pairs(known, copies=2).values())
    assert sorted(several) == [0, 0, 1, 1, 2, 2]
    assert len(pairs(known, copies=9)) == QUERIES


def test_the_loss_is_lowest_where_each_object_is_found_once(known: Answer) -> None:
    best = matching.loss(known, example())
    assert 0 <= best < 0.01
    logits = known.logits
    twice = torch.full_like(logits, NOTHING)
    twice[0, torch.arange(QUERIES), LABELS.repeat(2)] = -NOTHING
    for worse in (
        replace(known, logits=-logits),
        replace(known, logits=logits.flip(-1)),
        replace(known, logits=torch.full_like(logits, NOTHING)),
        replace(known, logits=twice),
        replace(known, boxes=known.boxes + 4.0),
    ):
        assert matching.loss(worse, example()) > best + 0.05


def test_a_class_is_to_be_as_sure_as_its_box_is_right() -> None:
    shifted = BOXES[:1] + torch.tensor([0.0, 0, 10, 0])
    iou = 30 / 40
    logits = torch.linspace(-3, 5, 161)
    lost = [
        float(matching.loss(Answer(shifted[None], one.reshape(1, 1, 1)), example(BOXES[:1], LABELS[:1])))
        for one in logits
    ]
    assert float(logits[torch.tensor(lost).argmin()].sigmoid()) == pytest.approx(iou, abs=0.02)


def test_images_without_objects_teach_that_there_is_nothing(known: Answer) -> None:
    nothing = example(torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64))
    silent = replace(known, logits=torch.full_like(known.logits, NOTHING))
    assert 0 <= matching.loss(silent, nothing) < 1e-3 < matching.loss(known, nothing)


def test_generalised_iou_of_boxes_that_overlap_touch_and_lie_apart() -> None:
    box = torch.tensor([0.0, 0, 2, 2])
    others = torch.tensor([[0.0, 0, 2, 2], [1, 0, 3, 2], [2, 0, 4, 2], [4, 0, 6, 2]])
    torch.testing.assert_close(matching.likeness(box, others), torch.tensor([1, 1 / 3, 0, -1 / 3]))


def test_the_distance_is_that_of_middles_and_sizes() -> None:
    box = torch.tensor([10.0, 10, 30, 30])
    others = torch.tensor([[13.0, 14, 33, 34], [10, 10, 36, 30]])
    torch.testing.assert_close(matching.distance(box, others), torch.tensor([7.0, 9.0]))
