"""Passes in bfloat16: answers and gradients near those in float32, also where a detector is sure; scores do not use them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from cavbench.core.pair import choose
from cavbench.detection import Detector, PatchThreat, Predictions
from cavbench.detection.access import PatchEnforcer
from cavbench.detection.half import Precision
from cavbench.envs.camera.world import StopSignApproach


class Sure(Detector):
    """A convolution and a product of matrices, then a probability; `bias` says how sure it is."""

    names = ("car", "stop sign")
    stride = 8

    def __init__(self, bias: float = 0.0) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(0)
        self.convolution = nn.Conv2d(3, 16, 8, 8)
        self.product = nn.Linear(16, 2)
        for value in self.parameters():
            value.data = 0.2 * torch.randn(value.shape, generator=generator)
        self.bias = bias
        self.seen: list[torch.dtype] = []

    def predict(self, pictures: Tensor) -> Predictions:
        cells = self.product(self.convolution(pictures).flatten(2).mT.relu())
        self.seen.append(cells.dtype)
        boxes = torch.zeros(len(pictures), cells.shape[1], 4) + torch.tensor([0.0, 0, 8, 8])
        return Predictions(boxes, (cells[..., 0] + self.bias).sigmoid(), cells.softmax(-1))


def answered(detector: Detector, pictures: Tensor, precision: Precision) -> tuple[Predictions, Tensor]:
    enforcer = PatchEnforcer(detector.eval(), PatchThreat(), "gradients", torch.Generator())
    leaf = pictures.clone().requires_grad_(True)
    found = enforcer.oracle.differentiable(leaf, precision)
    found.scores_of(1).amax(-1).sum().backward()
    assert leaf.grad is not None
    assert (enforcer.spent, enforcer.backwards) == (len(pictures), len(pictures))
    return found, leaf.grad


def pictures() -> Tensor:
    return torch.rand(4, 3, 32, 32, generator=torch.Generator().manual_seed(1))


def test_convolutions_and_products_are_in_bfloat16_and_answers_in_float32() -> None:
    detector = Sure()
    (half, gradient), (full, wanted) = (answered(detector, pictures(), one) for one in ("bfloat16", "float32"))
    assert detector.seen == [torch.bfloat16, torch.float32]
    for ours, theirs in zip(
        (half.boxes, half.objectness, half.classes), (full.boxes, full.objectness, full.classes), strict=True
    ):
        assert ours.dtype is torch.float32
        torch.testing.assert_close(ours, theirs, atol=0.02, rtol=0)
    assert torch.nn.functional.cosine_similarity(gradient.flatten(), wanted.flatten(), dim=0) > 0.99


@pytest.mark.parametrize("bias", [7.0, 9.0])
def test_the_gradient_of_a_sure_detector_does_not_vanish(bias: float) -> None:
    """In bfloat16 the probability would be 1, and its gradient 0."""
    (half, gradient), (full, wanted) = (answered(Sure(bias), pictures(), one) for one in ("bfloat16", "float32"))
    assert bool((half.objectness.detach() < 1).all())
    assert float((half.objectness - full.objectness).abs().max()) < 1e-3
    assert float(gradient.norm() / wanted.norm()) == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize(
    ("name", "alike"), [("yolov3_tiny", 0.8), ("yolov5", 0.8), ("fcos", 0.8), ("rcnn", 0.8), ("detr", 0.5)]
)
def test_what_ships_answers_nearly_the_same(name: str, alike: float) -> None:
    """`detr` chooses other queries where two are nearly as good."""
    world = StopSignApproach()
    detector = choose("victim", name).component.load(0, world.facts)
    scenes = world.training_scenes()
    shown = scenes.render(torch.tensor([0]), None, 0.5)[:, :, :256, -256:]
    (half, gradient), (full, wanted) = (answered(detector, shown, one) for one in ("bfloat16", "float32"))
    assert float((half.scores.amax((1, 2)) - full.scores.amax((1, 2))).abs().max()) < 0.1
    assert bool(gradient.isfinite().all())
    assert torch.nn.functional.cosine_similarity(gradient.flatten(), wanted.flatten(), dim=0) > alike


def test_a_patch_is_scored_in_float32() -> None:
    detector = Sure()
    answered(detector, pictures(), "bfloat16")
    with torch.no_grad():
        found = detector(pictures())
    assert detector.seen[-1] is torch.float32
    assert np.isfinite(found.objectness).all()
