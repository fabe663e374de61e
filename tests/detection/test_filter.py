"""A filter before a detector: the detector receives the changed images, and the gradient passes as if there were none."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from cavbench.defenses.detection.jpeg import JPEG
from cavbench.defenses.detection.median import MedianSmoothing
from cavbench.detection import DetectorDefense
from cavbench.detection.filter import FilteredDetector, ImageFilter
from tests.plugins.toy_camera import RedStreet, RedVictim

BOTH = [MedianSmoothing(size=5), JPEG(quality=30)]


def pictures(count: int = 2) -> Tensor:
    return torch.rand(count, 3, 32, 32, generator=torch.Generator().manual_seed(0))


def guarded(defense: DetectorDefense) -> FilteredDetector:
    found = defense.load(RedVictim(), 0, RedStreet().facts)
    assert isinstance(found, FilteredDetector)
    return found


@pytest.mark.parametrize("defense", BOTH, ids=["median", "jpeg"])
def test_the_detector_receives_the_transformed_image_and_the_gradient_is_straight_through(
    defense: DetectorDefense,
) -> None:
    door, shown = guarded(defense), pictures().requires_grad_(True)
    through = door.defense.filter(shown.detach()).requires_grad_(True)
    assert torch.allclose(door(shown).scores, door.inner(through).scores, atol=1e-6)
    door(shown).scores.sum().backward()
    door.inner(through).scores.sum().backward()
    assert shown.grad is not None
    assert through.grad is not None
    assert shown.grad.abs().sum() > 0
    assert torch.allclose(shown.grad, through.grad, atol=1e-6)


@pytest.mark.parametrize("defense", BOTH, ids=["median", "jpeg"])
def test_images_of_a_batch_are_transformed_independently(defense: DetectorDefense) -> None:
    shown = pictures(3)
    door = guarded(defense)
    assert torch.equal(door.defense.filter(shown)[1:2], door.defense.filter(shown[1:2]))
    assert (door.names, door.stride) == (door.inner.names, door.inner.stride)


@dataclass(frozen=True, kw_only=True)
class Grey(ImageFilter):
    def filter(self, pictures: Tensor) -> Tensor:
        return pictures.mean(1, keepdim=True)


@dataclass(frozen=True, kw_only=True)
class GreyDifferentiably(Grey):
    differentiable = True


@pytest.mark.parametrize("defense", [Grey(), GreyDifferentiably()])
def test_an_answer_of_another_shape_is_refused_not_repeated(defense: ImageFilter) -> None:
    detector = defense.load(RedVictim(), 0, RedStreet().facts)
    with pytest.raises(ValueError, match=r"the filter Grey.* of that shape"):
        detector(pictures())
