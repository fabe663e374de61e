"""Photographs made from rendered frames: a patch on them looks as the renderer shows it; bad pictures are one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image

from cavbench.core.options import configured
from cavbench.detection import Scenes
from cavbench.envs.camera import sign
from cavbench.envs.camera.photos import CORNERS, LIST, StopSignPhotos
from cavbench.envs.camera.photos_axes import AXES
from cavbench.envs.camera.street.layout import sign_x
from cavbench.envs.camera.world import StopSignApproach
from cavbench.errors import UserError
from tests.checks.rules import broken

FRAMES = (4, 9)
CELL = AXES.cell(light="as_taken")


def rendered() -> Scenes:
    world = StopSignApproach()
    return world.approaches(world.axes.cell(lanes=3, density=1.0, weather="clear"), range(1))[0].scenes


def corners(scenes: Scenes, number: int) -> NDArray[np.float64]:
    """The corners of the sign in a frame, clockwise from the left end of the upper edge."""
    pose = scenes.poses[number]  # type: ignore[attr-defined]
    return np.asarray(pose.camera.project(sign.corners(sign_x(pose.lanes))))[[2, 1, 0, 7, 6, 5, 4, 3]]


def write(folder: Path, given: dict[str, tuple[NDArray[np.uint8], NDArray[np.float64]]]) -> Path:
    lines = [",".join(("picture", *CORNERS))]
    for name, (picture, places) in given.items():
        Image.fromarray(picture).save(folder / name)
        lines.append(",".join([name, *(f"{each:.3f}" for each in places.ravel())]))
    (folder / LIST).write_text("\n".join(lines) + "\n")
    return folder


def taken(scenes: Scenes, number: int) -> NDArray[np.uint8]:
    shown = scenes.render(torch.tensor([number]), None, 0.5)[0]
    return (shown * 255).round().to(torch.uint8).permute(1, 2, 0).numpy()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    scenes = rendered()
    # The nearer one first: the world puts them in order.
    given = {f"{n}.png": (taken(scenes, n), corners(scenes, n)) for n in sorted(FRAMES, reverse=True)}
    return write(tmp_path_factory.mktemp("photos"), given)


def test_it_keeps_the_rules(folder: Path) -> None:
    assert broken("world", "photos", path=str(folder), side=1248) == {}


def photos(folder: Path) -> Scenes:
    (approach,) = StopSignPhotos(path=str(folder), side=1248).approaches(CELL, range(1))
    return approach.scenes


def test_without_a_patch_the_pictures_are_shown_as_they_are(folder: Path) -> None:
    scenes, street = photos(folder), rendered()
    assert (scenes.distance.diff() < 0).all()
    for place, number in enumerate(FRAMES):
        picture = (scenes.render(torch.tensor([place]), None, 0.5)[0] * 255).round().to(torch.uint8)
        height, width = street.size
        assert torch.equal(picture[:, :height, :width].permute(1, 2, 0), torch.from_numpy(taken(street, number)))
        assert torch.allclose(scenes.boxes[place], street.boxes[number], atol=0.6)


def test_a_patch_on_a_picture_looks_as_the_renderer_shows_it(folder: Path) -> None:
    scenes, street = photos(folder), rendered()
    patch = torch.rand(1, 3, 6, 6, generator=torch.Generator().manual_seed(5))
    for place, number in enumerate(FRAMES):
        x0, y0, x1, y1 = street.reach(0.5)[number].int().tolist()
        wanted = street.render(torch.tensor([number]), patch, 0.5)[0]
        found = scenes.render(torch.tensor([place]), patch, 0.5)[0][:, : wanted.shape[1], : wanted.shape[2]]
        error = (found - wanted).abs()
        plain = (street.render(torch.tensor([number]), None, 0.5)[0] - wanted).abs()
        assert float(error[:, y0:y1, x0:x1].mean()) < 0.06
        assert float(error[:, y0:y1, x0:x1].mean()) < 0.35 * float(plain[:, y0:y1, x0:x1].mean())


def test_a_patch_changes_no_pixel_beyond_its_reach_and_has_a_gradient(folder: Path) -> None:
    scenes = photos(folder)
    patch = torch.full((1, 3, 8, 8), 0.5, requires_grad=True)
    frames = torch.arange(2)
    shown, bare = scenes.render(frames, patch, 0.5), scenes.render(frames, None, 0.5)
    for number, (x0, y0, x1, y1) in enumerate(scenes.reach(0.5).int().tolist()):
        rows, columns = (shown[number] != bare[number]).any(0).nonzero().T
        assert x0 <= columns.min() <= columns.max() < x1
        assert y0 <= rows.min() <= rows.max() < y1
    shown.sum().backward()
    assert patch.grad is not None
    assert (patch.grad > 0).all()


def test_pictures_that_were_changed_are_another_world(folder: Path, tmp_path: Path) -> None:
    first = StopSignPhotos(path=str(folder))
    scenes = rendered()
    other = StopSignPhotos(path=str(write(tmp_path, {"4.png": (taken(scenes, 4), corners(scenes, 4))})))
    assert first.sha256 != other.sha256
    with pytest.raises(ValueError, match="other pictures"):
        StopSignPhotos(path=str(tmp_path), sha256=first.sha256)


def refused(folder: Path) -> str:
    with pytest.raises(UserError) as error:
        configured("world", "photos", {"path": str(folder)}).component.doubts([])
    assert len(str(error.value).splitlines()) == 1
    return str(error.value)


def test_bad_pictures_are_one_line(tmp_path: Path) -> None:
    scenes = rendered()
    picture, good = taken(scenes, 9), corners(scenes, 9)

    def tried(places: NDArray[np.float64], shown: NDArray[np.uint8] = picture) -> str:
        return refused(write(tmp_path, {"a.png": (shown, places)}))

    assert "outside the picture" in tried(good + np.array([2000, 0]))
    assert "clockwise" in tried(good[::-1])
    assert "begin with x3,y3" in tried(np.roll(good, 2, 0))
    dented = good.copy()
    dented[0] = good.mean(0)
    assert "without a dent" in tried(dented)
    assert "flat octagon" in tried(good + np.array([(0, 0), (0, 0), (0, 0), (0, 0), (25, 12), (0, 0), (0, 0), (0, 0)]))
    assert "no red sign" in tried(good, np.full_like(picture, 128))
    assert "at least 12" in tried(good.mean(0) + (good - good.mean(0)) / 20)
    assert "finite" in tried(np.full((8, 2), np.nan))
    write(tmp_path, {"a.png": (picture, good)})
    (tmp_path / "a.png").write_bytes((tmp_path / "a.png").read_bytes()[:5000])
    assert "cannot read the picture" in refused(tmp_path)
    (tmp_path / "a.png").unlink()
    assert "there is no picture" in refused(tmp_path)
    (tmp_path / LIST).write_text("picture,x1\na.png,3\n")
    assert "has no column" in refused(tmp_path)
    (tmp_path / LIST).write_text(",".join(("picture", *CORNERS)) + "\n../a.png" + ",1" * 16 + "\n")
    assert "name of a file in the folder" in refused(tmp_path)
    (tmp_path / LIST).unlink()
    assert "there is no" in refused(tmp_path)


@pytest.mark.parametrize("width", [14, 60])
def test_corners_that_begin_at_another_one_would_turn_the_patch(width: int, tmp_path: Path) -> None:
    scenes = rendered()
    picture, good = taken(scenes, 9), corners(scenes, 9)
    share = width / np.ptp(good[:, 0])
    size = tuple(round(each * share) for each in picture.shape[1::-1])
    smaller = np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BOX))
    places = good * share
    for first in range(1, 8):
        folder = write(tmp_path, {"a.png": (smaller, np.roll(places, first, 0))})
        with pytest.raises(UserError, match=f"begin with x{first + 1},y{first + 1}"):
            StopSignPhotos(path=str(folder), side=max(size)).approaches(CELL, range(1))
    StopSignPhotos(path=str(write(tmp_path, {"a.png": (smaller, places)})), side=max(size)).approaches(CELL, range(1))


def test_the_example_in_the_docs_is_a_sign() -> None:
    page = (Path(__file__).parents[3] / "docs" / "worlds" / "photos.md").read_text()
    (line,) = (line.strip() for line in page.splitlines() if "street.jpg," in line)
    shown = np.array([float(each) for each in line.split(",")[1:]]).reshape(8, 2)
    assert np.abs(shown - corners(rendered(), FRAMES[0])).max() < 0.1
