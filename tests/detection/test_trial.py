"""A detector whose score would be wrong is refused; one that sees no sign is told with what it would see one."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import cavbench
from cavbench.core.pair import choose
from cavbench.detection import Detector, Predictions
from cavbench.detection.trial import try_detector
from cavbench.detection.victims.from_file import DetectorFile
from cavbench.envs.camera.world import StopSignApproach
from cavbench.errors import UserError
from tests.detection.victims.test_from_file import NAMES, RedCells, torch_file
from tests.plugins.toy_camera import RED_V1, RedDetector, RedStreet, RedVictim

WORLD = RedStreet()


class Changed(RedDetector):
    """`RedDetector`, whose objectness is changed by what a subclass makes of it."""

    def changed(self, objectness: Tensor, pictures: Tensor) -> Tensor:
        raise NotImplementedError

    def predict(self, pictures: Tensor) -> Predictions:
        found = super().predict(pictures)
        return Predictions(found.boxes, self.changed(found.objectness, pictures), found.classes)


class OfTheBatch(Changed):
    def changed(self, objectness: Tensor, pictures: Tensor) -> Tensor:
        return (objectness - 0.1 * pictures.mean()).clamp(0, 1)


class Draws(Changed):
    def changed(self, objectness: Tensor, pictures: Tensor) -> Tensor:
        return objectness * torch.rand(1)


class Remembers(Changed):
    """Keeps the last score of each picture in a list, which has no weight."""

    def changed(self, objectness: Tensor, pictures: Tensor) -> Tensor:
        self.last = objectness.detach().tolist()
        return objectness


class NaN(Changed):
    def changed(self, objectness: Tensor, pictures: Tensor) -> Tensor:
        return objectness / 0.0 * 0.0


class Thresholds(Changed):
    def changed(self, objectness: Tensor, pictures: Tensor) -> Tensor:
        return (objectness > 0.5).float()


class Rooted(Changed):
    def changed(self, objectness: Tensor, pictures: Tensor) -> Tensor:
        return objectness + 0.0 * (pictures - pictures.detach())[:, :, 0].abs().sqrt().mean((1, 2))[:, None]


class Sleeps(Changed):
    def changed(self, objectness: Tensor, pictures: Tensor) -> Tensor:
        return objectness * 1e-3


def tried(detector: Detector, victim: Any = None) -> list[str]:
    return try_detector(detector.requires_grad_(False).eval(), victim or RedVictim(), WORLD, alone=True)


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        (OfTheBatch, "predicts otherwise for a picture"),
        (Draws, "predicts otherwise when it is shown the same again"),
        (Remembers, "remembers earlier pictures in 'last'"),
        (NaN, "NaN, infinite"),
    ],
)
def test_a_detector_whose_score_would_be_wrong_is_refused(kind: Callable[[], Detector], said: str) -> None:
    with pytest.raises(UserError, match=said):
        tried(kind())


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        (RedDetector, ""),
        (Thresholds, "has no gradient"),
        (Rooted, "gradient with NaN"),
        (Sleeps, "sees no stop sign in 4 clear, near frames without a patch, so its score says nothing"),
    ],
)
def test_what_a_score_cannot_say_is_said(kind: Callable[[], Detector], said: str) -> None:
    (line, *more) = tried(kind()) or [""]
    assert (said in line, more) == (True, [])
    assert bool(line) == bool(said)


class Byte(RedCells):
    """Takes pixels up to 255, as OpenCV reads them."""

    def forward(self, pictures: Tensor) -> tuple[Tensor, ...]:
        return super().forward(pictures / 255)


class BGR(RedCells):
    def forward(self, pictures: Tensor) -> tuple[Tensor, ...]:
        return super().forward(pictures.flip(1))


class Rows(RedCells):
    """Writes [y1, x1, y2, x2] as shares of the picture, as TensorFlow does."""

    def forward(self, pictures: Tensor) -> tuple[Tensor, ...]:
        boxes, scores = super().forward(pictures)
        return boxes[..., [1, 0, 3, 2]] / 32, scores


class Centres(RedCells):
    def forward(self, pictures: Tensor) -> tuple[Tensor, ...]:
        boxes, scores = super().forward(pictures)
        return torch.cat(((boxes[..., :2] + boxes[..., 2:]) / 2, boxes[..., 2:] - boxes[..., :2]), -1), scores


@pytest.mark.parametrize(
    ("kind", "wrong", "right"),
    [
        (Byte, {}, "victim.scaling=byte"),
        (BGR, {}, "victim.channels=bgr"),
        (Rows, {"normalised": True, "boxes": "centre"}, "victim.boxes=corners_yx"),
        (Centres, {"boxes": "corners_yx", "channels": "bgr"}, "victim.channels=rgb victim.boxes=centre"),
    ],
)
def test_a_file_with_wrong_settings_is_told_the_right_ones(
    kind: Callable[[], RedCells], wrong: dict[str, Any], right: str, tmp_path: Path
) -> None:
    path = torch_file(tmp_path / "detector.pt2", kind())
    victim = DetectorFile(path=path, names=NAMES, frame=32, **wrong)
    network = victim.read(("car", "stop sign"), "")
    (line,) = tried(network, victim)
    assert re.search(rf"with {right} it has (1.00|0.9\d)$", line), line
    meant = {word.partition("=")[0].removeprefix("victim."): word.partition("=")[2] for word in right.split()}
    assert tried(DetectorFile(path=path, names=NAMES, frame=32, **{**wrong, **meant}).load(0, WORLD.facts)) == []


def test_class_names_in_another_order_are_told(tmp_path: Path) -> None:
    victim = DetectorFile(path=torch_file(tmp_path / "detector.pt2"), names="stop sign+car", frame=32)
    (line,) = tried(victim.load(0, WORLD.facts), victim)
    assert "it sees 'car' there: are its class names in its own order?" in line


def test_the_line_is_given_before_the_score(tmp_path: Path) -> None:
    victim = DetectorFile(path=torch_file(tmp_path / "detector.pt2", Byte()), names=NAMES, frame=32)
    options: dict[str, Any] = {"lanes": 3, "density": 1, "weather": "clear", "episodes": 1, "seeds": [0]}
    with pytest.warns(UserWarning, match="with victim.scaling=byte it has"):
        cavbench.score(victim, "none", world=WORLD, grid=RED_V1, baselines=False, out=tmp_path, **options)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["yolov3_tiny", "yolov5"])
def test_the_zoos_detectors_pass(name: str) -> None:
    world = StopSignApproach()
    victim = choose("victim", name).component
    assert try_detector(victim.load(0, world.facts), victim, world, alone=True) == []
