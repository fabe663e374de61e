"""Properties of every YOLO: box positions, gradients, and independence of the images in a batch."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import nn

from cavbench.detection import Detector
from cavbench.detection.victims import yolo
from cavbench.detection.victims.yolov3_tiny import YOLOv3TinyNetwork
from cavbench.detection.victims.yolov5 import YOLOv5Network

ANCHORS = {
    "yolov3_tiny": {32: ((81, 82), (135, 169), (344, 319)), 16: ((23, 27), (37, 58), (81, 82))},
    "yolov5": {
        8: ((10, 13), (16, 30), (33, 23)),
        16: ((30, 61), (62, 45), (59, 119)),
        32: ((116, 90), (156, 198), (373, 326)),
    },
}


def untrained(name: str) -> Detector:
    """An untrained network with random batch-norm statistics, so that folding changes something."""
    torch.manual_seed(0)
    network = YOLOv3TinyNetwork() if name == "yolov3_tiny" else YOLOv5Network("n")
    for layer in network.modules():
        if isinstance(layer, nn.BatchNorm2d):
            for tensor, (low, high) in (
                (layer.weight, (0.5, 2)),
                (layer.bias, (-1, 1)),
                (layer.running_mean, (-1, 1)),
                (layer.running_var, (0.5, 2)),
            ):
                nn.init.uniform_(tensor, low, high)
    return network.eval()


@pytest.fixture(scope="module", params=list(ANCHORS))
def name(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def raw(name: str) -> Detector:
    return untrained(name)


@pytest.fixture(scope="module")
def network(raw: Detector) -> Detector:
    return yolo.frozen(copy.deepcopy(raw))


def test_freezing_does_not_change_the_predictions(raw: Detector, network: Detector) -> None:
    pictures = torch.rand(2, 3, 96, 64)
    before, after = raw(pictures), network(pictures)
    torch.testing.assert_close(after.scores, before.scores, rtol=0, atol=1e-4)
    torch.testing.assert_close(after.boxes, before.boxes, rtol=1e-4, atol=1e-2)
    assert not any(isinstance(layer, nn.BatchNorm2d) for layer in network.modules())
    assert not any(weight.requires_grad for weight in network.parameters())
    assert before.scores.std() > 1e-3


def test_zero_logits_put_every_anchor_in_the_middle_of_every_cell(name: str) -> None:
    """By the papers' equations, logits of 0 give the middle of the cell, the anchor's size, and a probability of 0.5."""
    network = untrained(name)
    for layer in network.modules():
        if isinstance(layer, nn.Conv2d) and layer.bias is not None:
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)
    height, width = 64, 96
    wanted = {
        (x + stride / 2 - w / 2, y + stride / 2 - h / 2, x + stride / 2 + w / 2, y + stride / 2 + h / 2)
        for stride, anchors in ANCHORS[name].items()
        for w, h in anchors
        for x in range(0, width, stride)
        for y in range(0, height, stride)
    }
    found = network(torch.rand(1, 3, height, width))
    assert {tuple(box) for box in found.boxes[0].tolist()} == wanted
    assert found.boxes.shape == (1, len(wanted), 4)
    assert found.classes.shape == (1, len(wanted), 80)
    assert found.scores.unique().tolist() == [0.25]


def test_scores_are_probabilities(network: Detector) -> None:
    found = network(torch.rand(2, 3, 64, 64))
    for values in (found.objectness, found.classes, found.scores):
        assert 0 <= values.min() <= values.max() <= 1
    assert (found.boxes[..., 2:] > found.boxes[..., :2]).all()


def test_predictions_do_not_depend_on_the_batch(network: Detector) -> None:
    pictures = torch.rand(3, 3, 64, 96)
    together = network(pictures)
    for row, picture in enumerate(pictures):
        alone = network(picture[None])
        torch.testing.assert_close(together.scores[row], alone.scores[0], rtol=0, atol=1e-4)
        torch.testing.assert_close(together.boxes[row], alone.boxes[0], rtol=1e-4, atol=1e-2)


@pytest.mark.parametrize("what", ["boxes", "objectness", "classes"])
def test_the_gradient_reaches_every_pixel_of_its_own_image_only(network: Detector, what: str) -> None:
    pictures = torch.rand(2, 3, 64, 64, requires_grad=True)
    getattr(network(pictures), what)[0].sum().backward()
    assert pictures.grad is not None
    assert (pictures.grad[0] != 0).float().mean() > 0.99
    assert not pictures.grad[1].any()
