"""A plate beside the sign: it is lit as the sign is, it changes nothing else, and a gradient reaches all of it."""

from __future__ import annotations

import pytest
import torch

from cavbench.detection.mount import Mount
from cavbench.detection.scenes import Scenes
from cavbench.envs.camera.bank import BankScenes
from cavbench.envs.camera.world import StopSignApproach

WORLD = StopSignApproach()
BESIDE = Mount(place="beside")
SHARE = 0.5
PATCH = torch.rand(1, 3, 12, 12, generator=torch.Generator().manual_seed(0))


def scenes(weather: str) -> Scenes:
    cell = WORLD.facts.axes.cell(lanes=3, density=1.0, weather=weather)
    (approach,) = WORLD.approaches(cell, range(1))
    return approach.scenes


@pytest.mark.parametrize(("weather", "most"), [("clear", 0.03), ("rain", 0.03), ("fog", 0.02), ("night", 0.07)])
def test_a_plate_is_lit_as_the_sign_is(weather: str, most: float) -> None:
    """On the sign itself a patch is known exactly. One light for all of it is right on the whole, and off by a little a pixel."""
    shown = scenes(weather)
    assert isinstance(shown, BankScenes)
    for frame in (0, len(shown) - 1):
        exact = shown.developed(torch.tensor([frame]), PATCH, 0.4)[0]
        plate = shown._plate(frame)
        whole = 0, 0, shown.size[1], shown.size[0]
        found = plate.beside(plate.cut(whole), whole, PATCH[0], (0.3, 0.3, 0.7, 0.7))
        changed = (exact != plate.cut(whole)).any(0) & (found != plate.cut(whole)).any(0)
        assert changed.sum() > 10
        difference = (exact - found)[:, changed]
        assert difference.mean().abs() < 0.01
        assert difference.abs().mean() < most


def test_it_changes_nothing_but_its_place() -> None:
    shown = scenes("clear").mounted(BESIDE)
    frames = torch.arange(len(shown))
    plain, attacked = (shown.render(frames, texels, SHARE) for texels in (None, PATCH))
    for frame, (other, box, reach) in enumerate(
        zip((plain != attacked).any(1), shown.boxes, shown.reach(SHARE), strict=True)
    ):
        down, across = other.nonzero(as_tuple=True)
        assert len(down), frame
        assert across.min() >= reach[0]
        assert across.max() < reach[2]
        assert down.min() >= reach[1]
        assert down.max() < reach[3]
        assert reach[2] <= box[0] + 2, "the sign is not covered"


def test_a_window_is_a_part_of_the_image() -> None:
    shown = scenes("clear").mounted(BESIDE)
    frames = torch.tensor([len(shown) - 1])
    corner = (shown.boxes[frames, :2] - 60).round().long().clamp(min=0)
    (part,) = shown.windows(frames, PATCH, SHARE, corner, (100, 100))
    (x, y), (whole,) = corner[0].tolist(), shown.render(frames, PATCH, SHARE)
    torch.testing.assert_close(part, whole[:, y : y + 100, x : x + 100])


def test_the_gradient_reaches_every_texel() -> None:
    shown = scenes("clear").mounted(BESIDE)
    patch = torch.full((1, 3, 8, 8), 0.5, requires_grad=True)
    shown.render(torch.tensor([len(shown) - 1]), patch, SHARE).sum().backward()
    assert patch.grad is not None
    assert (patch.grad > 0).all()


def test_a_plate_beside_a_sign_out_of_sight_changes_nothing() -> None:
    """On five lanes the sign has left the image in the last frames, and the frame holds no light of it."""
    cell = WORLD.facts.axes.cell(lanes=5, density=2.0, weather="rain")
    (approach,) = WORLD.approaches(cell, range(1))
    shown = approach.scenes.mounted(BESIDE)
    gone = (shown.visible == 0).nonzero().flatten()
    assert len(gone)
    assert torch.equal(shown.render(gone, PATCH, SHARE), shown.render(gone, None, SHARE))


def test_nothing_is_certain_under_a_patch_that_covers_nothing() -> None:
    assert not BESIDE.covers
    assert Mount().covers
    assert not Mount("light").covers
