"""Windows of training scenes: the box stays on the sign."""

from __future__ import annotations

import pytest
import torch

from cavbench.detection import STOP_SIGN
from cavbench.detection.victims.windows import Views, Windows
from tests.detection.drawn_street import DrawnStreet

SIDE = 128


@pytest.fixture(scope="module")
def windows() -> Windows:
    generator = torch.Generator().manual_seed(0)
    return Windows(DrawnStreet().training_scenes(), SIDE, zoom=(0.5, 2.0), away=0.0, generator=generator)


def test_a_box_lies_on_the_sign_in_every_window(windows: Windows) -> None:
    """A green patch covers the whole sign; the box must lie on it."""
    views = windows.draw(12)
    green = torch.tensor([0.0, 1.0, 0.0])[:, None, None].expand(1, 3, 8, 8)
    shown = windows.cut(views, windows.scenes.render(views.frames, green, 1.0))
    boxes = views.boxes(windows.scenes.boxes[views.frames], SIDE).clamp(0, SIDE)
    seen = 0
    for picture, box in zip(shown, boxes, strict=True):
        x0, y0, x1, y1 = box.round().int().tolist()
        if x1 - x0 < 8 or y1 - y0 < 8:
            continue
        seen += 1
        greenness = picture[1] - picture[[0, 2]].amax(0)
        inside = greenness[y0 + 2 : y1 - 2, x0 + 2 : x1 - 2]
        assert inside.mean() > 0.9
        assert (greenness > 0.5).sum() < 1.4 * (x1 - x0) * (y1 - y0)
    assert seen > 6


def test_frames_without_a_patch_are_not_rendered_again(windows: Windows) -> None:
    views = windows.draw(3)
    fresh = windows.scenes.render(views.frames, None, 0.5)
    torch.testing.assert_close(windows.cut(views), windows.cut(views, fresh), rtol=0, atol=0.5 / 255 + 1e-6)


def test_targets_are_the_objects_inside_the_window(windows: Windows) -> None:
    box = windows.scenes.boxes[0]
    middle = (box[:2] + box[2:]) / 2
    sides = torch.tensor([100.0, 100.0])
    corners = torch.stack((middle - 50, torch.zeros(2)))
    boxes, labels = windows.objects(Views(torch.tensor([0, 0]), corners, sides), [STOP_SIGN].index)
    assert [len(each) for each in boxes] == [1, 0]
    assert labels[0].tolist() == [0]
    torch.testing.assert_close((boxes[0][0, :2] + boxes[0][0, 2:]) / 2, torch.full((2,), SIDE / 2), rtol=0, atol=1e-3)


def test_batches_of_windows_get_the_same_light(windows: Windows) -> None:
    plain = torch.full((4, 3, SIDE, SIDE), 0.5)
    one, other = windows.lit(plain, plain)
    assert torch.equal(one, other)
    means = one.mean((2, 3))
    assert means.std(0).min() > 0.01
    assert one.min() >= 0
    assert one.max() <= 1
