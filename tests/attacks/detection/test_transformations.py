"""The image transformations equal kornia's, and so does their gradient inside the patch."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia.augmentation import ColorJiggle, RandomAffine, RandomPerspective
from torch import Tensor, nn

from cavbench.attacks.detection.transformations import Transformations

OFF = dict.fromkeys(
    ["rotation", "scale", "perspective", "brightness", "contrast", "saturation", "hue", "noise"], 0.0
)  # fmt: skip
ON = {
    "rotation": 30.0, "scale": 0.4, "perspective": 0.4, "brightness": 0.3, "contrast": 0.3, "saturation": 0.3,
    "hue": 0.3, "noise": 0.02,
}  # fmt: skip
HEIGHT, WIDTH = 24, 32


def pictures(seed: int) -> Tensor:
    return torch.rand(2, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(seed))


def by_kornia(**strength: float) -> nn.Module:
    """All transformations except the noise, computed by kornia with the full graph."""
    size, colours = strength["scale"], ("brightness", "contrast", "saturation", "hue")
    return nn.Sequential(
        RandomAffine(strength["rotation"], scale=(1 - size, 1 + size), padding_mode="reflection", p=1.0),
        RandomPerspective(strength["perspective"], p=1.0),
        ColorJiggle(*(strength[name] for name in colours), p=1.0),
    )


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    left=st.integers(0, WIDTH - 1),
    top=st.integers(0, HEIGHT - 1),
    width=st.integers(1, 12),
    height=st.integers(1, 12),
)
def test_values_and_gradients_equal_kornias(seed: int, left: int, top: int, width: int, height: int) -> None:
    box = torch.tensor([left, top, min(left + width, WIDTH), min(top + height, HEIGHT)], dtype=torch.float32)
    boxes = torch.stack((box, torch.tensor([3.0, 5.0, 9.0, 11.0])))
    weight = torch.rand(2, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(seed + 1)) - 0.5
    seen = []
    for transform in (lambda shown: by_kornia(**ON)(shown).clamp(0, 1), lambda shown: without_noise(shown, boxes)):
        torch.manual_seed(seed)
        shown = pictures(seed).requires_grad_()
        values = transform(shown)
        (values * weight).sum().backward()
        assert shown.grad is not None
        part = [
            grad[:, int(y0) : int(y1), int(x0) : int(x1)]
            for grad, (x0, y0, x1, y1) in zip(shown.grad, boxes, strict=True)
        ]
        seen.append((values.detach(), torch.cat([grad.flatten() for grad in part])))
    (kornias, its_gradient), (ours, our_gradient) = seen
    torch.testing.assert_close(ours, kornias, atol=1e-4, rtol=0)
    # A value on the edge of a clamp or of a hue's sixth may go either way.
    differ = (our_gradient - its_gradient).abs() > 1e-2 * (1 + its_gradient.abs())
    assert differ.float().mean() <= 0.02


def without_noise(shown: Tensor, boxes: Tensor) -> Tensor:
    return Transformations(**ON | {"noise": 0.0})(shown, boxes)


@pytest.mark.parametrize("name", [*OFF, "all"])
def test_each_can_be_switched_off(name: str) -> None:
    torch.manual_seed(0)
    off = OFF if name == "all" else ON | {name: 0.0}
    transformed = Transformations(**off)(pictures(0), torch.tensor([[3.0, 5.0, 9.0, 11.0]]).expand(2, 4))
    assert transformed.shape == (2, 3, HEIGHT, WIDTH)
    assert 0 <= transformed.min() <= transformed.max() <= 1
    assert torch.equal(transformed, pictures(0)) == (name == "all")


def test_noise_has_the_given_standard_deviation() -> None:
    torch.manual_seed(0)
    grey = torch.full((4, 3, 64, 64), 0.5)
    noisy = Transformations(**OFF | {"noise": 0.05})(grey, torch.tensor([[10.0, 10.0, 20.0, 20.0]]).expand(4, 4))
    assert (noisy - grey).std().item() == pytest.approx(0.05, rel=0.02)


def test_boxes_are_carried_to_where_the_warps_move_their_content() -> None:
    shown = torch.zeros(4, 3, 64, 64)
    shown[:, :, 24:34, 20:32] = 1
    boxes = torch.tensor([[20.0, 24.0, 32.0, 34.0]]).expand(4, 4)
    torch.manual_seed(0)
    transform = Transformations(**OFF | {"rotation": 20.0, "scale": 0.3, "perspective": 0.3})
    moved = transform(shown, boxes)
    for picture, box in zip(moved, transform.carried(boxes), strict=True):
        rows, columns = (picture[0] > 0.5).nonzero().T
        found = torch.stack([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]).float()
        assert (found - box).abs().max() < 2.5
