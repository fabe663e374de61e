"""Segmentation and completion: the filling, the gradient, the training, and the shipped U-Net."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import load_file
from torch import Tensor, nn

from cavbench import zoo
from cavbench.defenses.detection.completion import closed, filled
from cavbench.defenses.detection.marker import Marker
from cavbench.defenses.detection.segmenter import SMOOTH, Completed, Segmenter
from cavbench.defenses.detection.textures import textures
from cavbench.detection.victims.yolov3_tiny import YOLOv3Tiny
from cavbench.detection.victims.yolov5 import YOLOv5
from cavbench.envs.camera.world import StopSignApproach
from cavbench.errors import UserError
from tests.detection.drawn_street import DrawnStreet
from tests.plugins.toy_camera import RedStreet, RedVictim

FACTS = StopSignApproach().facts
QUICK = Segmenter(updates=3, batch=3, window=64, trained_in="DrawnStreet")


def random(*shape: int) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(0))


@settings(max_examples=25, deadline=None)
@given(height=st.integers(1, 40), width=st.integers(1, 40), share=st.floats(0, 1))
def test_filling_changes_marked_pixels_only_and_invents_no_colour(height: int, width: int, share: float) -> None:
    pictures, kept = 0.2 + 0.5 * random(2, 3, height, width), (random(2, 1, height, width) < share).float()
    found = filled(pictures, kept)
    same = kept.bool().expand_as(pictures)
    assert torch.equal(found[same], pictures[same])
    if kept.flatten(1).any(1).all():
        assert found.min() > 0.2 - 1e-4
        assert found.max() < 0.7 + 1e-4


def test_a_hole_in_one_colour_is_filled_with_it() -> None:
    pictures, kept = torch.full((1, 3, 50, 70), 0.3), torch.ones(1, 1, 50, 70)
    pictures[..., 10:40, 20:60], kept[..., 10:40, 20:60] = 1.0, 0.0
    assert torch.allclose(filled(pictures, kept), torch.tensor(0.3), atol=1e-5)


def test_closing_fills_holes_and_gaps_and_makes_marks_one_pixel_wider() -> None:
    odds = torch.full((1, 1, 24, 24), -1.0)
    odds[..., 8:16, 8:16] = 1.0
    odds[..., 10:13, 8:16] = -1.0
    wanted = torch.full_like(odds, -1.0)
    wanted[..., 7:17, 7:17] = 1.0
    assert torch.equal(closed(odds, 2), wanted)


class Bright(nn.Module):
    """Marks what is bright."""

    def forward(self, pictures: Tensor) -> Tensor:
        return 20 * (nn.functional.avg_pool2d(pictures, 2).mean(1, keepdim=True) - 0.5)


def test_the_detector_sees_the_completed_image_and_the_gradient_is_that_of_soft_marks() -> None:
    door = Completed(RedVictim().load(0, RedStreet().facts), Bright(), 0.5)
    shown = 0.4 * random(2, 3, 32, 32)
    shown[..., 12:22] += 0.5
    odds = door.log_odds(shown)
    assert 0 < (odds > 0).float().mean() < 1
    seen = door.transform(shown)
    assert torch.allclose(door(shown).scores, door.inner(seen).scores, atol=1e-6)
    asked, soft = shown.clone().requires_grad_(True), shown.clone().requires_grad_(True)
    door(asked).scores.sum().backward()
    through = seen.clone().requires_grad_(True)
    door.inner(through).scores.sum().backward()
    filled(soft, (-door.log_odds(soft) / SMOOTH).sigmoid()).backward(through.grad)
    assert asked.grad is not None
    assert soft.grad is not None
    assert asked.grad.abs().sum() > 0
    assert torch.allclose(asked.grad, soft.grad, atol=1e-6)


class Sure(nn.Module):
    """Marks everything, without a doubt."""

    def forward(self, pictures: Tensor) -> Tensor:
        return 20 + 0 * nn.functional.avg_pool2d(pictures, 2).mean(1, keepdim=True)


def test_the_gradient_of_a_sure_mark_does_not_vanish() -> None:
    door = Completed(RedVictim().load(0, RedStreet().facts), Sure(), 0.5)
    asked = random(1, 3, 32, 32).requires_grad_(True)
    door(asked).scores.sum().backward()
    assert asked.grad is not None
    assert asked.grad.abs().max() > 1e-6


def test_images_of_any_even_or_odd_size_are_marked_independently() -> None:
    torch.manual_seed(0)
    marker = Marker().eval()
    shown = random(3, 3, 44, 61)
    with torch.no_grad():
        assert marker(shown).shape == (3, 1, 22, 31)
        assert torch.allclose(marker(shown)[1:2], marker(shown[1:2]), atol=1e-5)


def test_textures_are_images_and_repeat_with_their_generator() -> None:
    clean = (255 * random(2, 3, 48, 64)).byte()
    one, again = (textures(20, 16, clean, torch.Generator().manual_seed(3)) for _ in range(2))
    assert one.shape == (20, 3, 16, 16)
    assert one.min() >= 0
    assert one.max() <= 1
    assert torch.equal(one, again)


def test_it_trains_the_marks_only_and_the_zoo_finds_them(
    victim: YOLOv5, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path / "zoo"))
    made = QUICK.train(victim, DrawnStreet(), seed=0, progress=lambda share, text: None)
    recipe = zoo.Recipe.of(victim, QUICK)
    path = zoo.save(made.network, recipe, seed=0, world=DrawnStreet(), card=made.card, start=made.start)
    assert all(name.startswith("marker.") for name in load_file(path))
    shown = random(1, 3, 64, 64)
    again = QUICK.load(victim, 7, FACTS)
    assert torch.allclose(again(shown).scores, made.network(shown).scores, rtol=0.02, atol=1e-3)
    other = replace(QUICK, certainty=0.2).load(victim, 0, FACTS)
    assert isinstance(again, Completed)
    assert isinstance(other, Completed)
    assert (other.log_odds(shown) > again.log_odds(shown)).all()
    with pytest.raises(UserError, match="certainty is no part of the training"):
        replace(QUICK, certainty=0.2).train(victim, DrawnStreet(), seed=0, progress=lambda share, text: None)


def test_all_victims_get_the_same_marks_and_the_control_others(victim: YOLOv5) -> None:
    def marks(detector: YOLOv5 | RedVictim, hard: float) -> list[Tensor]:
        made = replace(QUICK, hard=hard).train(detector, DrawnStreet(), seed=1, progress=lambda share, text: None)
        assert isinstance(made.network, Completed)
        return list(made.network.marker.parameters())

    one, other, control = marks(victim, 0.5), marks(RedVictim(), 0.5), marks(victim, 0.0)
    assert all(map(torch.equal, one, other))
    assert not all(map(torch.equal, one, control))


def test_impossible_options_are_refused() -> None:
    for bad in ({"certainty": 0.0}, {"certainty": 1.0}, {"hard": 1.5}, {"bare": -0.1}, {"updates": 0}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            Segmenter(**bad)


def test_the_shipped_marks_are_on_the_patch_and_not_on_the_sign() -> None:
    world = StopSignApproach()
    (approach,) = world.approaches(world.axes.cell(lanes=3, density=1.0, weather="clear"), range(1))
    scenes, frames = approach.scenes, torch.tensor([3, 7])
    detector = Segmenter().load(YOLOv3Tiny(), 0, FACTS)
    assert isinstance(detector, Completed)
    with torch.no_grad():
        bare, patched = (scenes.render(frames, patch, 0.5) for patch in (None, random(1, 3, 32, 32)))
        covered = (bare - patched).abs().amax(1, keepdim=True) > 0.1
        marked = detector.log_odds(patched) > 0
        assert marked[covered].float().mean() > 0.8
        assert marked[~covered].float().mean() < 0.01
        assert (detector.log_odds(bare) > 0).float().mean() < 0.01
