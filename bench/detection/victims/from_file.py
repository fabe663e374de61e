"""An object detector in an ONNX or torch.export file of the user."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from operator import itemgetter
from pathlib import Path
from typing import get_args

import torch
from torch import Tensor

from cavbench import bounded
from cavbench.core.contracts import Facts
from cavbench.core.ranges import Count
from cavbench.detection import STOP_SIGN, DetectorVictim
from cavbench.detection.victims import coco
from cavbench.detection.victims.file_network import Boxes, FileDetector, Input, Order, Output, Scaling
from cavbench.errors import UserError, short
from cavbench.formats import onnx_runtime, torch_program
from cavbench.formats.trial import hashed, refuse_harm

Network = Callable[[Tensor], Sequence[Tensor]]
ONNX, TORCH = ".onnx", ".pt2"
LARGEST_NAMES = 2**20
"""Most bytes of a file of class names."""
MOST_IMAGES, MOST_PIXELS = 64, 4096
"""The largest fixed batch size, and the largest fixed height and width."""
SIDE = 320
"""Side in pixels of the images on which a file is tried: the window of `eot`."""
TOLERANCE = {torch.float32: 1e-4, torch.float16: 1e-2}
"""By so much may scores be outside of [0, 1] or depend on the batch, from rounding."""
SMALL, LARGE = 2.0, 10.0
"""Boxes in pixels reach beyond the first; boxes in shares of the image stay below the second."""


@dataclass(frozen=True, kw_only=True)
class DetectorFile(DetectorVictim):
    """Your own detector as an ONNX (.onnx) or torch.export (.pt2) file. Nothing in the file is executed.

    A .pt2 file has gradients for white-box attacks. An .onnx file has none: attacks that need gradients are refused. It needs
    ONNX Runtime: pip install 'cavbench[onnx]'.

    The input is [N, 3, H, W] float32 or float16; N, H and W are fixed in the file or dynamic. To a fixed size, images are fitted
    with a grey border. The output has all predictions before non-maximum suppression: boxes [N, K, 4] and scores [N, K, C] in
    [0, 1], or one tensor as YOLO detectors return it.

    Args:
        path: the file.
        names: class names in the order of the scores, one of which is "stop sign": joined by `+`, as in "car+stop sign", or a
            text file with one in each line; empty for the 80 classes of COCO.
        boxes: `corners`: [x1, y1, x2, y2]; `corners_yx`: [y1, x1, y2, x2], as TensorFlow writes them; `centre`: [x, y, width,
            height]; `auto`: corners if boxes are an output of their own, otherwise centre, as in YOLO.
        normalised: boxes are shares of the input's width and height, not pixels.
        scaling: values of the pixels: `unit`: [0, 1]; `byte`: [0, 255]; `imagenet`: [0, 1], minus the mean of ImageNet, over its
            standard deviation.
        channels: their order.
        frame: longer side in pixels of the world's images, if the input size is fixed. Such an image fills the input, and smaller
            windows of it are shown at the same scale.
    """

    path: str
    names: str = ""
    boxes: Boxes = "auto"
    normalised: bool = False
    scaling: Scaling = "unit"
    channels: Order = "rgb"
    frame: Count = 1248

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.path.endswith((ONNX, TORCH)):
            raise ValueError(f"path must end with {ONNX} or {TORCH}, got {short(self.path)!r}")
        if self.path.endswith(ONNX):
            # Both depend on the file's format.
            object.__setattr__(self, "answers", "scores")
            object.__setattr__(self, "libraries", (onnx_runtime.LIBRARY,))

    def alternatives(self) -> Mapping[str, DetectorVictim]:
        """Other readings of its pixels and boxes, which differ in one or two parameters; those that differ in one come first."""
        choices: dict[str, tuple[object, ...]] = {
            "scaling": get_args(Scaling),
            "channels": get_args(Order),
            "boxes": ("auto", "corners", "corners_yx", "centre"),
            "normalised": (False, True),
        }
        found: list[tuple[int, str, DetectorVictim]] = []
        for values in itertools.product(*choices.values()):
            given = dict(zip(choices, values, strict=True))
            words = [
                f"victim.{name}={str(value).lower()}" for name, value in given.items() if value != getattr(self, name)
            ]
            found.append((len(words), " ".join(words), replace(self, **given)))  # type: ignore[arg-type]
        return {words: victim for count, words, victim in sorted(found, key=itemgetter(0)) if count in (1, 2)}

    def zoo_name(self) -> str:
        """A file has no trained or defended versions.

        Raises:
            UserError: always.
        """
        raise UserError("a detector in a file cannot be trained: leave out the training or the defence that needs one")

    def load(self, seed: int, facts: Facts) -> FileDetector:
        """The detector in the file, the same for any seed.

        Raises:
            UserError: if the file is missing, cannot be read, is not a detector or does not match the other parameters.
        """
        names, sha256 = self._names(), hashed(self.path, "detector")
        if self.names:
            sha256 = hashlib.sha256("\n".join((sha256, *names)).encode()).hexdigest()
        refuse_harm(self.path, _check, self, names, sha256)
        _check(self, names, sha256)
        return self.read(names, sha256)

    def read(self, names: tuple[str, ...], sha256: str) -> FileDetector:
        """The detector, not tried yet.

        Raises:
            UserError: if the file cannot be read, or its input is not one of images.
        """
        path = Path(self.path).expanduser()
        try:
            network, shape, dtype, sha256 = (
                _onnx(path, self.path, sha256) if path.suffix == ONNX else _torch(path, self.path, sha256)
            )
        except UserError:
            raise
        # A truncated file, or one in another format, can fail anywhere in the library that reads it.
        except Exception as error:
            kind = "an ONNX model" if path.suffix == ONNX else "a program of torch.export.save"
            raise UserError(f"{self.path} cannot be read: it is not {kind}, or a damaged one") from error
        given = Input(*self._sizes(shape), dtype, self.frame, self.scaling, self.channels)
        return FileDetector(network, self.path, names, given, Output(self.boxes, self.normalised), sha256)

    def _sizes(self, shape: Sequence[int | None]) -> tuple[int | None, tuple[int, int] | None]:
        """The batch size, and height and width, of the shape of an input; None for any."""
        batch, *rest = shape or (0,)
        match rest if batch is None or 0 < batch <= MOST_IMAGES else []:
            case [3 | None, None, None]:
                return batch, None
            case [3 | None, int(height), int(width)] if min(height, width) > 0 and max(height, width) <= MOST_PIXELS:
                return batch, (height, width)
        sides = ", ".join("any" if side is None else str(side) for side in shape)
        raise UserError(
            f"{self.path} takes [{sides}]; a detector takes images [N, 3, H, W], with H and W both fixed, up to {MOST_PIXELS}, "
            f"or both dynamic, and N up to {MOST_IMAGES} or dynamic"
        )

    def _names(self) -> tuple[str, ...]:
        """The class names.

        Raises:
            UserError: if they cannot be read, or a stop sign is not among them.
        """
        names = _listed(self.names) if self.names else coco.NAMES
        if not all(name and name.isprintable() for name in names):
            raise UserError(f"victim.names={short(self.names)!r} has an empty name, or one that cannot be printed")
        if STOP_SIGN not in names:
            raise UserError(
                f"none of the classes in victim.names is {STOP_SIGN!r}, which attacks hide: {short(', '.join(names))!r}; "
                'join the names by "+", or give a text file with one in each line'
            )
        return names


def _listed(given: str) -> tuple[str, ...]:
    """Names joined by `+`, or the lines of a file."""
    try:
        path = Path(given).expanduser()
        if not path.is_file():
            return tuple(name.strip() for name in given.split("+"))
        found = bounded.content(path, most=LARGEST_NAMES, name=f"victim.names={short(given)}")
        return tuple(line.strip() for line in found.decode("utf-8").strip().splitlines())
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"victim.names={short(given)} cannot be read: {type(error).__name__}") from error


def _onnx(path: Path, name: str, sha256: str) -> tuple[Network, tuple[int | None, ...], torch.dtype, str]:
    model = onnx_runtime.read(path, name, sha256)
    return lambda pictures: model.run(pictures, model.outputs), model.shape, model.dtype, model.sha256


def _torch(path: Path, name: str, sha256: str) -> tuple[Network, tuple[int | None, ...], torch.dtype, str]:
    program = torch_program.read(path, name)
    if program.dtype not in (torch.float32, torch.float16):
        raise UserError(f"{name} takes {program.dtype or 'an unknown type'}; a detector takes float32 or float16")
    return program.graph, program.shape, program.dtype, sha256


@cache
def _check(victim: DetectorFile, names: tuple[str, ...], sha256: str) -> None:
    """Try a file on noise, a white image and a grey one, once in a process. Its kernels may crash on a crafted file.

    Raises:
        UserError: if it fails, or its predictions are not those of a detector.
    """
    detector = victim.read(names, sha256)
    tolerance = TOLERANCE[detector.given.dtype]
    pictures = torch.rand(3, 3, SIDE, SIDE, generator=torch.Generator().manual_seed(0))
    pictures[1], pictures[2] = 1.0, 0.5
    with torch.no_grad():
        alone, grey, together = detector.raw(pictures[:1]), detector.raw(pictures[2:]), detector.raw(pictures)
    boxes, objectness, classes = together[:3]
    path = victim.path
    if len({alone[0].shape, grey[0].shape, boxes[:1].shape}) > 1:
        raise UserError(
            f"{path} returns {alone[0].shape[1]} boxes for one image and {grey[0].shape[1]} for another: export it without "
            "non-maximum suppression, with a fixed number of boxes"
        )
    if not all(bool(part.isfinite().all()) for part in (*alone[:3], boxes, objectness, classes)):
        raise UserError(f"{path} returns boxes or scores that are NaN or infinite")
    low, high = min(float(objectness.min()), float(classes.min())), max(float(objectness.max()), float(classes.max()))
    if low < -tolerance or high > 1 + tolerance:
        raise UserError(
            f"{path} returns scores between {low:.3g} and {high:.3g}, they must be in [0, 1]: "
            "export it with its sigmoid or softmax"
        )
    _check_boxes(victim, boxes, together[3], together[4])
    first, among = ((part[1][0, :, None] * part[2][0]).sort(0).values for part in (alone, together))
    if not torch.allclose(first, among, rtol=tolerance, atol=tolerance):
        raise UserError(
            f"{path} returns other scores for an image if other images are in its batch: export it in eval mode"
        )
    if victim.answers == "gradients":
        _check_gradient(path, detector, pictures[:1])


def _check_boxes(victim: DetectorFile, boxes: Tensor, shift: Tensor, scale: Tensor) -> None:
    """Refuse boxes that are written in another way than the parameters say."""
    if bool((boxes[..., 2:] < boxes[..., :2]).any()):
        other = "set victim.boxes=centre" if victim.boxes != "centre" else "leave out victim.boxes=centre"
        raise UserError(
            f"{victim.path} returns boxes with x2 < x1 or y2 < y1; if they are [x, y, width, height], {other}"
        )
    largest = float(boxes.abs().max())
    if not victim.normalised and largest <= SMALL:
        raise UserError(
            f"{victim.path} returns boxes whose coordinates are at most {largest:.3g}: set victim.normalised=true"
        )
    if victim.normalised and largest > LARGE * float((SIDE * scale + 2 * shift).max()):
        raise UserError(f"{victim.path} returns boxes far beyond the image: leave out victim.normalised=true")


def _check_gradient(path: str, detector: FileDetector, picture: Tensor) -> None:
    """Refuse a program whose scores have no gradient in the pixels: a white-box attack would find nothing."""
    leaf = picture.clone().requires_grad_()
    scores = detector(leaf).scores
    try:
        (gradient,) = torch.autograd.grad(scores.sum(), leaf)
    except RuntimeError:
        gradient = torch.zeros(())
    if not bool(gradient.any()):
        raise UserError(
            f"{path} has no gradient from its scores to the pixels: export it without torch.no_grad, rounding and thresholds, "
            "or as .onnx to score it as a black box"
        )
    if not bool(gradient.isfinite().all()):
        raise UserError(f"{path} has a gradient from its scores to the pixels that is NaN or infinite")
