"""YOLOv3-tiny: the reader of its weights, the graph against a plain reading of Darknet's cfg, and the published weights."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import batch_norm, conv2d, interpolate, leaky_relu, max_pool2d, pad

from cavbench.detection.boxes import confidence, detections
from cavbench.detection.victims import yolo
from cavbench.detection.victims.yolov3_tiny import YOLOv3TinyNetwork, read_darknet
from cavbench.errors import UserError
from cavbench.zoo import fetch
from tests.detection.pictures import stop_sign

HEADER = np.array([0, 2, 0, 32_013_312, 0], "<i4").tobytes()
BYTES = 35_434_956
LAYERS = (
    (3, 16, 3, True),
    (16, 32, 3, True),
    (32, 64, 3, True),
    (64, 128, 3, True),
    (128, 256, 3, True),
    (256, 512, 3, True),
    (512, 1024, 3, True),
    (1024, 256, 1, True),
    (256, 512, 3, True),
    (512, 255, 1, False),
    (256, 128, 1, True),
    (384, 256, 3, True),
    (256, 255, 1, False),
)
"""Inputs, outputs, kernel size and batch normalisation of the cfg's convolutions."""


class Cfg:
    """The layers of yolov3-tiny.cfg in order; each reads its weights from the file in sequence."""

    def __init__(self, path: Path) -> None:
        self.values = torch.from_numpy(np.fromfile(path, "<f4", offset=20))

    def take(self, *shape: int) -> Tensor:
        count = int(np.prod(shape))
        taken, self.values = self.values[:count], self.values[count:]
        return taken.reshape(shape)

    def convolutional(self, x: Tensor, filters: int, size: int, *, normalise: bool = True) -> Tensor:
        bias = self.take(filters)
        scale, mean, variance = (self.take(filters) for _ in range(3)) if normalise else (None, None, None)
        y = conv2d(x, self.take(filters, x.shape[1], size, size), None if normalise else bias, padding=size // 2)
        return leaky_relu(batch_norm(y, mean, variance, scale, bias, eps=1e-6), 0.1) if normalise else y

    def __call__(self, x: Tensor) -> tuple[Tensor, Tensor]:
        for filters in (16, 32, 64, 128):
            x = max_pool2d(self.convolutional(x, filters, 3), 2, 2)
        middle = self.convolutional(x, 256, 3)
        x = self.convolutional(max_pool2d(middle, 2, 2), 512, 3)
        x = max_pool2d(pad(x, (0, 1, 0, 1), value=-1e30), 2, 1)
        x = self.convolutional(x, 1024, 3)
        neck = self.convolutional(x, 256, 1)
        coarse = self.convolutional(self.convolutional(neck, 512, 3), 255, 1, normalise=False)
        x = interpolate(self.convolutional(neck, 128, 1), scale_factor=2)
        x = self.convolutional(torch.cat((x, middle), 1), 256, 3)
        return coarse, self.convolutional(x, 255, 1, normalise=False)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A weights file of the right size with random numbers, scaled to preserve the size of the signal."""
    draw = np.random.default_rng(0)
    parts = []
    for inputs, outputs, size, normalised in LAYERS:
        parts += [draw.normal(0, 0.1, outputs)]
        if normalised:
            parts += [draw.uniform(0.5, 1.5, outputs), draw.normal(0, 0.1, outputs), draw.uniform(0.5, 1.5, outputs)]
        fan_in = inputs * size * size
        parts += [draw.normal(0, (2 / fan_in) ** 0.5, outputs * fan_in)]
    path = tmp_path_factory.mktemp("darknet") / "random.weights"
    path.write_bytes(HEADER + np.concatenate(parts).astype("<f4").tobytes())
    return path


@pytest.fixture(scope="module")
def network(path: Path) -> YOLOv3TinyNetwork:
    return read(path)


def read(path: Path) -> YOLOv3TinyNetwork:
    network = YOLOv3TinyNetwork()
    read_darknet(path, network)
    return yolo.frozen(network)


def test_the_network_equals_the_cfg_file(path: Path, network: YOLOv3TinyNetwork) -> None:
    """The network with folded batch normalisation equals the cfg file, evaluated layer by layer."""
    picture = torch.rand(1, 3, 64, 96)
    cfg = Cfg(path)
    heads = [head.reshape(1, 3, 85, -1).permute(0, 1, 3, 2).reshape(1, -1, 85) for head in cfg(picture)]
    wanted = torch.cat(heads, 1)[..., 4:].sigmoid()
    found = network(picture)
    torch.testing.assert_close(found.objectness, wanted[..., 0], rtol=0, atol=1e-4)
    torch.testing.assert_close(found.classes, wanted[..., 1:], rtol=0, atol=1e-4)
    assert wanted.std() > 0.01
    assert not len(cfg.values)


def test_it_has_the_published_size() -> None:
    assert sum(weight.numel() for weight in YOLOv3TinyNetwork().parameters()) == 8_852_366


@pytest.mark.parametrize("change", [-4, -1, 4])
def test_a_file_of_another_size_is_refused_in_one_line(path: Path, tmp_path: Path, change: int) -> None:
    blob = path.read_bytes()
    other = tmp_path / "other.weights"
    other.write_bytes(blob[:change] if change < 0 else blob + b"\0" * change)
    with pytest.raises(UserError, match=f"have {BYTES + change} bytes, YOLOv3TinyNetwork needs {BYTES}$"):
        read(other)


@pytest.mark.slow
def test_the_published_weights_match_the_download_table(published: YOLOv3TinyNetwork) -> None:
    content = fetch.place("yolov3_tiny").read_bytes()
    assert hashlib.sha256(content).hexdigest() == published.weights_sha256 == fetch.DOWNLOADS["yolov3_tiny"].sha256
    assert len(content) == fetch.DOWNLOADS["yolov3_tiny"].size
    assert not any(weight.requires_grad for weight in published.parameters())


@pytest.mark.slow
@pytest.mark.parametrize("size", [80, 120, 160, 200])
def test_a_stop_sign_is_found_where_it_is(published: YOLOv3TinyNetwork, size: int) -> None:
    picture, box = stop_sign(size)
    label = published.index("stop sign")
    predictions = published(picture[None])
    assert confidence(predictions, label, box[None], iou=0.7).item() > 0.8
    (found,) = detections(predictions, threshold=0.25, iou=0.45)
    assert found.labels.tolist() == [label]


@pytest.mark.slow
def test_a_small_stop_sign_has_a_box_of_its_size(published: YOLOv3TinyNetwork) -> None:
    """Checks the anchors of the fine head: with the anchors of the cfg file the boxes cover a third of the sign."""
    picture, box = stop_sign(60)
    assert confidence(published(picture[None]), published.index("stop sign"), box[None], iou=0.7).item() > 0.6


@pytest.mark.slow
def test_a_covered_stop_sign_is_not_found(published: YOLOv3TinyNetwork) -> None:
    picture, box = stop_sign(120)
    x1, y1, x2, y2 = box.int().tolist()
    picture[:, y1:y2, x1:x2] = 0.5
    assert confidence(published(picture[None]), published.index("stop sign"), box[None]).item() < 0.1


@pytest.mark.slow
def test_gradient_steps_too_small_to_see_hide_a_stop_sign(published: YOLOv3TinyNetwork) -> None:
    """Projected gradient descent within 8/255; a single step is not enough, because the scores are too rough."""
    picture, box = stop_sign(160)
    label = published.index("stop sign")
    shown = picture[None]
    for _ in range(8):
        shown = shown.detach().requires_grad_()
        (gradient,) = torch.autograd.grad(published(shown).scores[..., label].sum(), shown)
        change = shown - 2 / 255 * gradient.sign() - picture
        shown = (picture + change.clamp(-8 / 255, 8 / 255)).clamp(0, 1)
    before, after = (confidence(published(each), label, box[None]).item() for each in (picture[None], shown))
    assert before > 0.9
    assert after < 0.2
