"""A patch from a picture: its pixels are the texels, and the record names them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from cavbench.attacks.detection.given_patch import GivenPatch
from cavbench.core.options import configured
from cavbench.detection import PatchThreat
from cavbench.detection.access import PatchEnforcer
from cavbench.errors import UserError
from tests.attacks.detection.test_eot import SCENES
from tests.checks.rules import broken
from tests.plugins.toy_camera import RedDetector


def picture(path: Path, height: int = 16, width: int = 16) -> np.ndarray:
    pixels = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    Image.fromarray(pixels).save(path)
    return pixels


def test_the_pixels_are_the_texels(tmp_path: Path) -> None:
    pixels = picture(tmp_path / "a.png")
    attack = GivenPatch(path=str(tmp_path / "a.png"))
    enforcer = PatchEnforcer(RedDetector(), PatchThreat(), attack.access, torch.Generator())
    patch = attack.craft(enforcer.oracle, SCENES, lambda share, text: None)
    assert torch.equal((patch * 255).round().to(torch.uint8), torch.from_numpy(pixels).permute(2, 0, 1))
    assert enforcer.spent == 0


def test_it_keeps_the_rules(tmp_path: Path) -> None:
    picture(tmp_path / "a.png")
    assert broken("attack", "given_patch", path=str(tmp_path / "a.png")) == {}


def test_a_file_that_was_changed_is_another_attack_or_refused(tmp_path: Path) -> None:
    picture(tmp_path / "a.png")
    first = GivenPatch(path=str(tmp_path / "a.png"))
    assert GivenPatch(path=first.path, sha256=first.sha256) == first
    Image.fromarray(np.zeros((16, 16, 3), np.uint8)).save(tmp_path / "a.png")
    assert GivenPatch(path=first.path) != first
    with pytest.raises(ValueError, match="has other pixels"):
        GivenPatch(path=first.path, sha256=first.sha256)


@pytest.mark.parametrize(("height", "width"), [(16, 20), (7, 7), (513, 513)])
def test_what_is_no_patch_is_one_line(tmp_path: Path, height: int, width: int) -> None:
    picture(tmp_path / "a.png", height, width)
    with pytest.raises(UserError) as refused:
        configured("attack", "given_patch", {"path": str(tmp_path / "a.png")})
    assert len(str(refused.value).splitlines()) == 1
    assert "square" in str(refused.value)
