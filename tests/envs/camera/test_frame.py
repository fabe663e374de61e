"""Frames: a texture on the sign, weather, the bank on disk."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.numpy import save_file

from cavbench.detection.mount import Mount, Place, Shape
from cavbench.envs.camera import bank, develop, sign
from cavbench.envs.camera.bank import BankScenes
from cavbench.envs.camera.frame import frame
from cavbench.envs.camera.plate import detail, filtered
from cavbench.envs.camera.poses import approach
from cavbench.envs.camera.weather import air, streaks
from cavbench.envs.weather import WEATHERS, Weather
from cavbench.errors import UserError
from tests.envs.camera.scenes import lit, scenes

SCENES = scenes()


def test_a_sign_is_where_its_box_is() -> None:
    plain = scenes()
    pictures = plain.render(torch.arange(10), None, 0.5)
    assert pictures.shape == (10, 3, 384, 1248)
    assert pictures.min() >= 0
    assert pictures.max() <= 1
    red = (pictures[:, 0] - pictures[:, 1] > 0.25).float()
    for picture, (x0, y0, x1, y1) in zip(red, plain.boxes.tolist(), strict=True):
        rows, columns = picture.nonzero(as_tuple=True)
        found = [int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1]
        # The border is white, 2.25 % of the side.
        assert np.allclose(found, [x0, y0, x1, y1], atol=1.5 + 0.0225 * (x1 - x0))


def test_the_patch_covers_its_share_of_the_sign_and_nothing_else() -> None:
    plain = scenes()
    frames = torch.tensor([9])
    without, with_patch = plain.render(frames, None, 0.5), plain.render(frames, torch.ones(1, 3, 16, 16), 0.5)
    changed = (without - with_patch).abs().amax(1)[0] > 0.02
    rows, columns = changed.nonzero(as_tuple=True)
    x0, y0, x1, y1 = plain.boxes[9].tolist()
    assert int(columns.max() - columns.min()) + 1 == pytest.approx((x1 - x0) / 2, abs=2)
    assert int(rows.max() - rows.min()) + 1 == pytest.approx((y1 - y0) / 2, abs=2)
    assert float(columns.float().mean()) == pytest.approx((x0 + x1) / 2, abs=1)


def test_the_picture_is_differentiable_to_the_patch() -> None:
    """Compared with a central difference, in the linear part of the tone curve."""
    plain = scenes()
    patch = torch.full((1, 3, 8, 8), 0.5, requires_grad=True)
    weights = torch.randn(3, 384, 1248, generator=torch.Generator().manual_seed(0))

    def loss(value: torch.Tensor) -> torch.Tensor:
        return (plain.render(torch.tensor([8]), value, 0.5)[0] * weights).sum()

    (gradient,) = torch.autograd.grad(loss(patch), patch)
    direction = torch.randn(patch.shape, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        slope = (loss(patch + 0.01 * direction) - loss(patch - 0.01 * direction)) / 0.02
    assert float((gradient * direction).sum()) == pytest.approx(float(slope), rel=0.03)


def test_a_frame_does_not_depend_on_the_others_of_the_batch() -> None:
    plain = scenes("rain")
    patch = torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    together = plain.render(torch.tensor([0, 4, 9]), patch, 0.4)
    alone = torch.cat([plain.render(torch.tensor([number]), patch, 0.4) for number in (0, 4, 9)])
    assert torch.equal(together, alone)


@pytest.mark.parametrize("weather", ["rain", "fog"])
def test_weather_takes_contrast_from_the_far_sign_more_than_from_the_near_one(weather: str) -> None:
    clear, dim = scenes(), scenes(weather)
    contrast = []
    for number in (0, 9):
        x0, y0, x1, y1 = (int(edge) for edge in clear.boxes[number])
        spread = [s.render(torch.tensor([number]), None, 0.5)[0, :, y0:y1, x0:x1].std() for s in (dim, clear)]
        contrast.append(float(spread[0] / spread[1]))
    assert contrast[0] < contrast[1] < 1.1


@settings(max_examples=20, deadline=None)
@given(visibility=st.floats(20, 5000), distance=st.floats(1, 200))
def test_fog_follows_koschmieder(visibility: float, distance: float) -> None:
    depth = np.full((1, 4, 4), distance, np.float32)
    street = np.full((4, 4, 3), 0.1, np.float32)
    found = air(Weather(name="mist", visibility_m=visibility), depth, street, 10.0, 721.0, 0)
    assert np.allclose(found.transmitted, np.exp(-3.0 / visibility * distance), rtol=1e-4)
    assert np.allclose(found.added, 0.1 * (1 - found.transmitted), rtol=1e-4)


def test_a_pixel_that_shows_pole_and_sky_gets_the_mean_of_their_air() -> None:
    pole, sky = np.full((2, 4, 4), 10, np.float32), np.full((2, 4, 4), np.inf, np.float32)
    street = np.full((4, 4, 3), 0.1, np.float32)
    alone, none, both = (
        air(WEATHERS["fog"], depth, street, 10.0, 721.0, 0).transmitted
        for depth in (pole, sky, np.concatenate([pole, sky]))
    )
    assert np.allclose(both, (alone + none) / 2)
    assert alone.min() > 0.5
    assert none.max() < 0.01


def test_a_print_is_darker_than_the_sheeting_under_it_where_the_light_is_retroreflected() -> None:
    pose = approach("sun-behind-ego", 3, 1.0, "night")[6]
    matt = lit(pose)
    share = np.array([0.2, 0.3, 0.4], np.float32)
    white, printed = (
        BankScenes([(pose, frame(each, pose, WEATHERS["night"]))], ["night"])._plate(0)
        for each in (matt, replace(matt, printed=share))
    )
    face, dim = (
        filtered(sign.painted(torch.ones(1, 3, 8, 8), 0.5, plate.printed), detail(plate.crop))[0]
        for plate in (white, printed)
    )
    light = [develop.light_of(white.signed(part, white.crop)) for part in (face, dim)]
    row, column = (side // 2 for side in light[0].shape[1:])
    ratio = (light[1] / light[0])[:, row - 5 : row + 5, column - 5 : column + 5]
    assert torch.allclose(ratio.mean((1, 2)), torch.from_numpy(share), atol=0.01)
    plain = [plate.plain for plate in (white, printed)]
    assert torch.equal(*plain)


def test_more_rain_hides_more() -> None:
    depth = np.full((96, 312), 50, np.float32)
    cover = [streaks(rate, depth, 10.0, 180.0, np.random.default_rng(0)).mean() for rate in (2.0, 10.0, 50.0)]
    assert 0 < cover[0] < cover[1] < cover[2] < 0.5


def test_night_has_no_airlight() -> None:
    depth = np.full((1, 4, 4), 20, np.float32)
    found = air(WEATHERS["night"], depth, np.ones((4, 4, 3), np.float32), 10.0, 721.0, 0)
    assert np.array_equal(found.transmitted, np.ones((4, 4, 1), np.float32))
    assert not found.added.any()


def test_the_bank_gives_back_what_was_written(tmp_path: Path) -> None:
    poses = approach("sun-behind-ego", 4, 2.0, "sun")[:3]
    frames = [frame(lit(pose), pose, WEATHERS["clear"]) for pose in poses]
    bank.write(tmp_path, "sun-behind-ego", "clear", poses, frames, {"version": 0})
    for (pose, kept), wanted, original in zip(
        bank.read(tmp_path, "sun-behind-ego", "clear"), poses, frames, strict=True
    ):
        assert pose == wanted
        assert kept.crop == original.crop
        assert kept.scale == pytest.approx(original.scale)
        assert kept.printed == original.printed
        for name in ("picture", "black", "gain"):
            assert np.array_equal(getattr(kept, name), getattr(original, name))


def test_a_bank_that_is_not_there_or_cut_short_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="bench render"):
        bank.read(tmp_path, "sun-beside", "fog")
    bank.path_of(tmp_path, "sun-beside", "fog").write_bytes(b"\x10\0\0\0\0\0\0\0{}")
    with pytest.raises(UserError, match="cannot read the frames"):
        bank.read(tmp_path, "sun-beside", "fog")


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"printed": None}, "an earlier version of cavbench; `bench render` makes them again"),
        ({"scale": None}, "cannot read the frames .*: 'scale'"),
        ({"visible": np.zeros(0, np.float32)}, "cannot read the frames .*: index 0 is out of bounds"),
        ({"printed": np.zeros((1, 2), np.float32)}, "cannot read the frames .*: not enough values"),
        ({"crop": np.array([[0, 0, 9, 9]], np.int32)}, "cannot read the frames .*: cannot reshape"),
    ],
)
def test_a_bank_of_an_earlier_version_or_with_wrong_tensors_is_one_line(
    tmp_path: Path, changed: dict[str, NDArray[np.generic] | None], why: str
) -> None:
    pose = approach("sun-beside", 3, 1.0, "sun")[0]
    path = bank.write(tmp_path, "sun-beside", "clear", [pose], [frame(lit(pose), pose, WEATHERS["clear"])], {})
    with safe_open(path, "np") as file:
        kept = {name: file.get_tensor(name) for name in file.keys()} | changed  # noqa: SIM118
        save_file({name: value for name, value in kept.items() if value is not None}, path, file.metadata())
    with pytest.raises(UserError, match=why):
        bank.read(tmp_path, "sun-beside", "clear")


def test_a_picture_that_is_none_is_one_line() -> None:
    pose = approach("sun-beside", 3, 1.0, "sun")[0]
    broken = replace(frame(lit(pose), pose, WEATHERS["clear"]), picture=np.full(100, 7, np.uint8))
    with pytest.raises(UserError, match="cannot be decoded; `bench render` makes the frames again"):
        BankScenes([(pose, broken)], ["clear"]).render(torch.tensor([0]), None, 0.5)


def test_the_face_is_red_with_white_letters() -> None:
    face = sign.face()
    assert face.shape == (3, sign.TEXELS, sign.TEXELS)
    assert face.min() >= 0
    assert face.max() <= 1
    red = (face[0] - face[1] > 0.3).mean()
    white = (face.min(0) > 0.8).mean()
    assert red > 0.5
    assert 0.1 < white < 0.4


@settings(max_examples=20, deadline=None)
@given(
    frame=st.integers(0, 9),
    x=st.integers(0, 1248 - 96),
    y=st.integers(0, 384 - 64),
    share=st.floats(0.1, 1.0),
    patched=st.booleans(),
)
def test_a_window_is_a_part_of_the_picture(frame: int, x: int, y: int, share: float, patched: bool) -> None:
    frames = torch.tensor([frame, 9])
    patch = torch.rand(1, 3, 8, 8, generator=torch.Generator().manual_seed(frame)) if patched else None
    corners = torch.tensor([[x, y], [1248 - 96, 100]])
    windows = SCENES.windows(frames, patch, share, corners, (64, 96))
    whole = SCENES.render(frames, patch, share)
    cut = torch.stack([p[:, y : y + 64, x : x + 96] for p, (x, y) in zip(whole, corners.tolist(), strict=True)])
    torch.testing.assert_close(windows, cut, atol=1e-6, rtol=0)


@pytest.mark.parametrize("shape", ["square", "stickers", "light", "plate"])
@pytest.mark.parametrize("place", ["middle", "top"])
def test_a_patch_of_any_shape_changes_the_pixels_that_it_says_and_no_others(shape: Shape, place: Place) -> None:
    if shape != "square" and place != "middle":
        return
    scenes = SCENES.mounted(Mount(shape, place))
    frames, white, black = torch.arange(2), torch.ones(1, 3, 8, 8), torch.zeros(1, 3, 8, 8)
    seen = [scenes.developed(frames, patch, 0.5) for patch in (white, black)]
    for number, (x0, y0, x1, y1) in enumerate(scenes.reach(0.5).int().tolist()):
        if number < len(frames):
            rows, columns = (seen[0][number] != seen[1][number]).any(0).nonzero().T
            assert x0 <= columns.min() <= columns.max() < x1
            assert y0 <= rows.min() <= rows.max() < y1
    # Without a patch nothing is mounted.
    assert torch.equal(scenes.developed(frames, None, 0.5), SCENES.developed(frames, None, 0.5))


@pytest.mark.parametrize("share", [0.1, 0.5, 1.0])
def test_a_patch_reaches_no_farther_than_it_says(share: float) -> None:
    for number, (x0, y0, x1, y1) in enumerate(SCENES.reach(share).int().tolist()):
        plate = SCENES._plate(number)
        faces = sign.painted(torch.rand(1, 3, 8, 8), share)
        signed = plate.signed(filtered(faces, detail(plate.crop))[0], plate.crop)
        rows, columns = (signed != plate.plain).any(0).nonzero().T
        assert len(rows) > 0
        assert x0 <= columns.min() + plate.crop[0] <= columns.max() + plate.crop[0] < x1
        assert y0 <= rows.min() + plate.crop[1] <= rows.max() + plate.crop[1] < y1
