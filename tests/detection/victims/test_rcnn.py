"""The two-stage detector: its crops, what its second stage learns from, and how the stages work together."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from cavbench.detection.victims import rcnn
from cavbench.detection.victims.examples import Example
from cavbench.detection.victims.rcnn import CROP, LEARNT, LEARNT_OBJECTS, MAPS, PROPOSALS, RCNNNetwork, Seen

NAMES = ("stop sign", "car")
NOTHING = len(NAMES)
SIDE = 160


@pytest.fixture(scope="module")
def network() -> RCNNNetwork:
    torch.manual_seed(0)
    return RCNNNetwork(NAMES).eval()


@pytest.fixture(scope="module")
def seen(network: RCNNNetwork) -> Seen:
    with torch.no_grad():
        return network.propose(torch.rand(2, 3, SIDE, SIDE, generator=torch.Generator().manual_seed(0)))


def example(*boxes: list[list[float]]) -> Example:
    """Grey windows with cars at these boxes."""
    known = [torch.tensor(box).reshape(-1, 4) for box in boxes]
    labels = [torch.ones(len(box), dtype=torch.int64) for box in known]
    return Example(torch.full((len(boxes), 3, SIDE, SIDE), 0.5), known, labels)


def positions(axis: int) -> list[Tensor]:
    """Features that say where they are, in pixels of the image, along x (0) or y (1)."""
    maps = []
    for stride, channels in MAPS:
        at = (torch.arange(SIDE // stride) + 0.5) * stride
        grid = at.expand(len(at), -1) if axis == 0 else at.unsqueeze(1).expand(-1, len(at))
        maps.append(grid.expand(1, channels, -1, -1))
    return maps


@pytest.mark.parametrize("axis", [0, 1])
def test_a_crop_has_the_features_at_the_middles_of_its_bins(axis: int) -> None:
    boxes = torch.tensor([[[20.0, 32, 76, 60], [90, 80, 104, 150]]])
    crops = rcnn.crop(positions(axis), boxes)
    assert crops.shape == (2, sum(channels for _, channels in MAPS), CROP, CROP)
    low, high = boxes[0, :, axis], boxes[0, :, 2 + axis]
    wanted = low[:, None] + (high - low)[:, None] * (torch.arange(CROP) + 0.5) / CROP
    wanted = wanted[:, None, None, :] if axis == 0 else wanted[:, None, :, None]
    torch.testing.assert_close(crops, wanted.expand_as(crops))


def test_a_crop_of_one_image_does_not_see_another() -> None:
    features = [torch.stack((torch.zeros(c, 40, 40), torch.ones(c, 40, 40))) for _, c in MAPS]
    crops = rcnn.crop(features, torch.tensor([[[4.0, 4, 60, 60]] * 3, [[-20.0, 4, 200, 60]] * 3]))
    assert crops[:3].eq(0).all()
    assert crops[3:].eq(1).all()


def test_the_second_stage_leaves_boxes_at_first(network: RCNNNetwork, seen: Seen) -> None:
    places = torch.tensor([[[10.0, 20, 60, 64]], [[30.0, 30, 50, 90]]])
    with torch.no_grad():
        logits, boxes = network.second(seen.features, places)
    assert logits.shape == (2, 1, NOTHING + 1)
    torch.testing.assert_close(boxes, places)


def test_the_second_stage_learns_true_objects_and_the_surest_false_proposals(seen: Seen) -> None:
    car = [40.0, 40, 90, 80]
    places, names, targets = rcnn.learnt(seen, example([car], []), NOTHING)
    assert places.shape == targets.shape == (2, LEARNT, 4)
    assert places[0, 0].tolist() == car
    assert names[0, 0] == 1
    assert targets[0][names[0] == 1].eq(torch.tensor(car)).all()
    assert names[1].eq(NOTHING).all()
    surest = seen.raw.boxes[1][seen.objectness[1].argsort(descending=True)[:LEARNT]]
    torch.testing.assert_close(places[1], surest)


def test_most_places_have_no_object(seen: Seen) -> None:
    box = [20.0, 20, 140, 140]
    sure = replace(seen.raw, distances=torch.cat((seen.raw.cells - 20, 140 - seen.raw.cells), 1).expand(2, -1, 4))
    _, names, _ = rcnn.learnt(replace(seen, raw=sure), example([box], [box]), NOTHING)
    assert (names == 1).all(), "every proposal is the object, so there is nothing else to learn from"
    half = torch.arange(len(seen.raw.cells)) % 2 == 0
    mixed = replace(sure, distances=sure.distances.where(half[:, None], 1.0))
    _, names, _ = rcnn.learnt(replace(seen, raw=mixed), example([box], [box]), NOTHING)
    assert (names == 1).sum(1).eq(LEARNT_OBJECTS).all()


def test_its_score_is_that_of_both_stages(network: RCNNNetwork) -> None:
    pictures = torch.rand(2, 3, SIDE, SIDE, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        found, first = network(pictures), network.propose(pictures)
    assert found.boxes.shape == (2, PROPOSALS, 4)
    torch.testing.assert_close(found.objectness, first.objectness.topk(PROPOSALS, 1).values)
    assert (found.classes >= 0).all()
    assert (found.classes.sum(-1) < 1).all()
    assert len(network(pictures[:, :, :32, :32]).objectness[0]) < PROPOSALS


def test_both_stages_learn() -> None:
    torch.manual_seed(1)
    network = RCNNNetwork(NAMES).train()
    rcnn.loss(network, example([[40.0, 40, 90, 80]], [])).backward()
    for part in (network.first.score, network.first.place, network.second.name):
        assert part.weight.grad is not None
        assert part.weight.grad.abs().sum() > 0


def test_the_loss_falls_on_what_it_learns() -> None:
    torch.manual_seed(1)
    network = RCNNNetwork(NAMES).train()
    known = example([[40.0, 40, 90, 80]], [[10.0, 60, 50, 100]])
    for pictures, (box,) in zip(known.pictures, known.boxes, strict=True):
        x1, y1, x2, y2 = box.int().tolist()
        pictures[:, y1:y2, x1:x2] = torch.rand(3, 1, 1)
    adam = torch.optim.AdamW(network.parameters(), 2e-3)
    losses = []
    for _ in range(15):
        lost = rcnn.loss(network, known)
        adam.zero_grad()
        lost.backward()
        adam.step()
        losses.append(float(lost.detach()))
    assert losses[-1] < 0.6 * losses[0]


def test_a_window_without_objects_teaches_that_there_is_nothing(network: RCNNNetwork) -> None:
    assert torch.isfinite(rcnn.loss(network, example([], [])))
