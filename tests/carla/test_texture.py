"""The texture that is put on CARLA's sign."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from bench.errors import UserError
from envs.camera import sign
from envs.camera.carla.texture import WHOLE, laid_out, stuck_on


def test_without_a_patch_it_is_the_face() -> None:
    face = stuck_on(None, 0.5)
    assert face.shape == (sign.TEXELS, sign.TEXELS, 3)
    assert np.abs(face / 255 - sign.face().transpose(1, 2, 0)).max() <= 0.5 / 255 + 1e-6


@pytest.mark.parametrize(("texels", "share"), [(8, 0.5), (100, 0.5), (512, 0.25)])
def test_a_patch_covers_a_square_in_the_middle_and_nothing_else(texels: int, share: float) -> None:
    patch = torch.tensor([0.0, 1.0, 0.2]).reshape(3, 1, 1).expand(3, texels, texels)
    face, plain = stuck_on(patch, share), stuck_on(None, share)
    side = round(share * sign.TEXELS)
    edge = (sign.TEXELS - side) // 2
    assert (face[edge : edge + side, edge : edge + side] == (0, 255, 51)).all()
    face[edge : edge + side, edge : edge + side] = plain[edge : edge + side, edge : edge + side]
    assert (face == plain).all()


def test_a_patchs_first_row_is_the_upper_one() -> None:
    patch = torch.zeros(3, 32, 32)
    patch[:, :16] = 1.0
    face = stuck_on(patch, 0.5)
    assert face[sign.TEXELS // 2 - 60, sign.TEXELS // 2].tolist() == [255, 255, 255]
    assert face[sign.TEXELS // 2 + 60, sign.TEXELS // 2].tolist() == [0, 0, 0]


def test_a_patch_that_wants_gradients_is_sent_to_the_embedded_world() -> None:
    with pytest.raises(UserError, match="craft the patch in the embedded camera world, then score it here"):
        stuck_on(torch.zeros(3, 32, 32, requires_grad=True), 0.5)


def test_a_face_can_fill_the_texture_be_upside_down_or_mirrored() -> None:
    face = stuck_on(None, 0.5)
    assert (laid_out(face, WHOLE) == face).all()
    assert (laid_out(face, (0.0, 1.0, 1.0, 0.0)) == face[::-1]).all()
    assert (laid_out(face, (1.0, 0.0, 0.0, 1.0)) == face[:, ::-1]).all()


def test_a_face_can_lie_in_a_corner_of_the_texture() -> None:
    white = np.full((sign.TEXELS, sign.TEXELS, 3), 255, np.uint8)
    texture = laid_out(white, (0.5, 0.0, 1.0, 0.25))
    inside = np.zeros(texture.shape[:2], bool)
    inside[: sign.TEXELS // 4, sign.TEXELS // 2 :] = True
    assert (texture[inside] == 255).all()
    assert (texture[~inside] == np.round(np.array(sign.RED) * 255)).all()
