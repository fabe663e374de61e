"""YOLOv5 in its sizes n to x (architecture of release 6.0 and later) as a torch module, written from its published layer table.

The published weights are AGPL-3.0, so cavbench does not ship them: `cavbench.detection.victims.yolov5_file` reads a user's own
file, and the zoo has a detector trained with this module.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn

from cavbench import zoo
from cavbench.core.contracts import Facts, Progress, Trained
from cavbench.core.ranges import Count, NotNegative
from cavbench.detection import STOP_SIGN, CameraWorld, Detector, Predictions
from cavbench.detection.victims import coco, yolo, yolov5_file
from cavbench.detection.victims.examples import Example
from cavbench.detection.victims.learner import Learner
from cavbench.detection.victims.loss import mistaken, supervised
from cavbench.errors import UserError

Size = Literal["n", "s", "m", "l", "x"]
MULTIPLES: dict[Size, tuple[float, float]] = {
    "n": (0.33, 0.25),
    "s": (0.33, 0.50),
    "m": (0.67, 0.75),
    "l": (1.0, 1.0),
    "x": (1.33, 1.25),
}
"""Depth and width, as multiples of size l."""
ANCHORS = (
    ((10, 13), (16, 30), (33, 23)),
    ((30, 61), (62, 45), (59, 119)),
    ((116, 90), (156, 198), (373, 326)),
)
"""Width and height in pixels at 640 x 640, for the heads with strides 8, 16 and 32; a weights file has its own."""
STRIDES = (8, 16, 32)


def _silu(inputs: int, outputs: int, size: int = 1, stride: int = 1) -> yolo.Convolution:
    return yolo.Convolution(inputs, outputs, size, stride, eps=1e-3, activation=nn.SiLU(inplace=True))


class Bottleneck(nn.Module):
    """1 x 1 then 3 x 3 convolution, added to the input if `shortcut`."""

    def __init__(self, width: int, *, shortcut: bool) -> None:
        super().__init__()
        self.cv1 = _silu(width, width)
        self.cv2 = _silu(width, width, 3)
        self.shortcut = shortcut

    def forward(self, x: Tensor) -> Tensor:
        y = self.cv2(self.cv1(x))
        return x + y if self.shortcut else y


class C3(nn.Module):
    """A cross-stage partial block (Wang et al. 2020): half the width goes through `depth` bottlenecks, half bypasses them."""

    def __init__(self, inputs: int, outputs: int, depth: int, *, shortcut: bool) -> None:
        super().__init__()
        half = outputs // 2
        self.cv1 = _silu(inputs, half)
        self.cv2 = _silu(inputs, half)
        self.cv3 = _silu(2 * half, outputs)
        self.m = nn.Sequential(*(Bottleneck(half, shortcut=shortcut) for _ in range(depth)))

    def forward(self, x: Tensor) -> Tensor:
        return self.cv3(torch.cat((self.m(self.cv1(x)), self.cv2(x)), 1))


class SPPF(nn.Module):
    """Spatial pyramid pooling (He et al. 2014): maxima over 5, 9 and 13 cells, by repeated pooling over 5 cells."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.cv1 = _silu(width, width // 2)
        self.cv2 = _silu(2 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        levels = [self.cv1(x)]
        for _ in range(3):
            levels.append(nn.functional.max_pool2d(levels[-1], 5, stride=1, padding=2))
        return self.cv2(torch.cat(levels, 1))


class Detect(nn.Module):
    """The three heads: one 1 x 1 convolution each, and the anchors in units of the head's stride."""

    def __init__(self, widths: tuple[int, int, int], classes: int) -> None:
        super().__init__()
        self.m = nn.ModuleList(nn.Conv2d(width, len(ANCHORS[0]) * (5 + classes), 1) for width in widths)
        self.anchors: Tensor
        self.register_buffer("anchors", torch.tensor(ANCHORS) / torch.tensor(STRIDES)[:, None, None])

    def forward(self, *features: Tensor) -> Predictions:
        outputs = [head(x) for head, x in zip(self.m, features, strict=True)]
        anchors = self.anchors * torch.tensor(STRIDES).to(self.anchors)[:, None, None]
        return yolo.decode(outputs, anchors, STRIDES, _place)


def _place(raw: Tensor, cell: Tensor, anchor: Tensor) -> tuple[Tensor, Tensor]:
    """As in Scaled-YOLOv4 (Wang et al. 2021): centre 2 sigma(t) - 0.5 + c, size p (2 sigma(t))^2, at most four anchors."""
    doubled = 2 * raw.sigmoid()
    return doubled[..., :2] - 0.5 + cell, doubled[..., 2:].square() * anchor


RARE = (-5.0, -1.5)
"""Initial bias of objectness and of classes: most predictions contain no object (Lin et al. 2017)."""


class YOLOv5Network(Detector):
    """The network. Layers are numbered as in the published table, so that its state dict has the original names.

    Args:
        size: n, s, m, l or x.
        names: class names.
    """

    stride = STRIDES[-1]

    def __init__(self, size: Size, names: tuple[str, ...] = coco.NAMES) -> None:
        super().__init__()
        self.shape = {"size": size, "names": names}
        self.names = tuple(names)
        depth, width = MULTIPLES[size]
        w64, w128, w256, w512, w1024 = (math.ceil(full * width / 8) * 8 for full in (64, 128, 256, 512, 1024))
        d3, d6, d9 = (max(round(full * depth), 1) for full in (3, 6, 9))
        layers = {
            0: _silu(3, w64, 6, 2),
            1: _silu(w64, w128, 3, 2),
            2: C3(w128, w128, d3, shortcut=True),
            3: _silu(w128, w256, 3, 2),
            4: C3(w256, w256, d6, shortcut=True),
            5: _silu(w256, w512, 3, 2),
            6: C3(w512, w512, d9, shortcut=True),
            7: _silu(w512, w1024, 3, 2),
            8: C3(w1024, w1024, d3, shortcut=True),
            9: SPPF(w1024),
            10: _silu(w1024, w512),
            13: C3(2 * w512, w512, d3, shortcut=False),
            14: _silu(w512, w256),
            17: C3(2 * w256, w256, d3, shortcut=False),
            18: _silu(w256, w256, 3, 2),
            20: C3(2 * w256, w512, d3, shortcut=False),
            21: _silu(w512, w512, 3, 2),
            23: C3(2 * w512, w1024, d3, shortcut=False),
            24: Detect((w256, w512, w1024), len(names)),
        }
        self.model = nn.ModuleDict({str(number): layer for number, layer in layers.items()})

    def expect_little(self) -> None:
        """Initialise the biases so that an untrained network predicts almost no objects."""
        detect = self.model["24"]
        assert isinstance(detect, Detect)
        for head in detect.m:
            assert isinstance(head.bias, Tensor)
            biases = head.bias.data.unflatten(0, (-1, 5 + len(self.names)))
            biases[:, 4], biases[:, 5:] = RARE

    def predict(self, pictures: Tensor) -> Predictions:
        fine = self._through(pictures, 0, 1, 2, 3, 4)
        middle = self._through(fine, 5, 6)
        coarse = self._through(middle, 7, 8, 9, 10)
        # Path aggregation (Liu et al. 2018): from the coarse to the fine cells and back.
        lateral = self._through(_doubled(coarse), 13, 14, beside=middle)
        small = self._through(_doubled(lateral), 17, beside=fine)
        medium = self._through(self._through(small, 18), 20, beside=lateral)
        large = self._through(self._through(medium, 21), 23, beside=coarse)
        return self.model["24"](small, medium, large)

    def _through(self, x: Tensor, *numbers: int, beside: Tensor | None = None) -> Tensor:
        if beside is not None:
            x = torch.cat((x, beside), 1)
        for number in numbers:
            x = self.model[str(number)](x)
        return x


def _doubled(x: Tensor) -> Tensor:
    return nn.functional.interpolate(x, scale_factor=2)


@dataclass(frozen=True, kw_only=True)
class YOLOv5(Learner[YOLOv5Network]):
    """YOLOv5 in one of its sizes: trained on the camera world's training places, or with weights from your own file.

    Args:
        size: n, s, m, l or x: 1.9, 7.2, 21, 47 and 87 million parameters. The zoo ships a trained n.
        path: a `yolov5*.pt` of release 6.0 or later, or a .safetensors file written by cavbench; empty for the zoo's detector.
        trained: training seed of the zoo's detector; the seeds of a run are patch seeds.
        updates: number of weight updates in training.
        batch: windows per update.
        window: side of a window in pixels, a multiple of 32.
        away: share of the windows at uniformly random places; the others are near the sign.
        decoys: share of the windows with a decoy in the place of the stop sign.
        caution: weight of the surest stop sign that is not there, in decoys and elsewhere.
        learning_rate: maximum learning rate of AdamW.
        trained_in: non-default parameters of the training world; set by `bench train`.
    """

    training: ClassVar[int] = 2

    size: Size = "n"
    path: str = ""
    updates: Count = 1600
    caution: NotNegative = 2.0

    def zoo_name(self) -> str:
        return f"yolov5{self.size}"

    def load(self, seed: int, facts: Facts) -> YOLOv5Network:
        """The detector from the file or the zoo, the same for any seed."""
        if not self.path:
            recipe = zoo.Recipe.of(self)
            if self.trained not in zoo.seeds(recipe):
                hint = f"set victim.path=yolov5{self.size}.pt to use your own file"
                raise UserError(f"{zoo.missing(recipe, self.trained)}; or {hint}")
            return yolo.frozen(zoo.load(recipe, self.trained, YOLOv5Network))
        weights = yolov5_file.read(Path(self.path).expanduser())
        network = YOLOv5Network(self.size, weights.names)
        try:
            network.load_state_dict(weights.tensors)
        except RuntimeError as error:
            reason = shorten(str(error).splitlines()[1], 200)
            raise UserError(f"{self.path} does not hold a YOLOv5{self.size} (victim.size): {reason}") from None
        network.weights_sha256 = weights.sha256
        return yolo.frozen(network)

    def train(self, world: CameraWorld, *, seed: int, progress: Progress) -> Trained[Detector]:
        """Train a detector from scratch on windows of the training scenes, with all objects in them as targets.

        Raises:
            UserError: if `path` is set, because the detector in the file is trained already.
        """
        if self.path:
            raise UserError("victim.path names a detector that is trained already; leave it out to train one")
        return super().train(world, seed=seed, progress=progress)

    @property
    def care(self) -> float:
        return 1 + self.caution

    def begun(self, names: tuple[str, ...]) -> YOLOv5Network:
        network = YOLOv5Network(self.size, names)
        network.expect_little()
        return network

    def loss(self, network: YOLOv5Network, example: Example) -> Tensor:
        predictions = network(example.pictures)
        label = network.index(STOP_SIGN)
        wrong = mistaken(predictions, label, *sign_of(example, label)).mean()
        return supervised(predictions, example.boxes, example.labels) + self.caution * wrong


def sign_of(example: Example, label: int) -> tuple[Tensor, Tensor]:
    """The box [N, 4] of the stop sign in each window, zeros where there is none, and whether there is one, bool [N]."""
    found = [box[kind == label][:1] for box, kind in zip(example.boxes, example.labels, strict=True)]
    there = torch.tensor([len(box) > 0 for box in found])
    return torch.stack([box[0] if len(box) else torch.zeros(4) for box in found]), there
