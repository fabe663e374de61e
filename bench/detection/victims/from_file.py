"""An object detector in an ONNX or torch.export file of the user."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from cavbench.core.contracts import Facts
from cavbench.detection.victims.file_network import FileDetector
from cavbench.detection.victims.first_look import look
from cavbench.detection.victims.reading import Foreign
from cavbench.errors import UserError, short
from cavbench.formats import onnx_runtime, torch_program
from cavbench.formats.trial import hashed, refuse_harm

Network = Callable[[Tensor], Sequence[Tensor]]
ONNX, TORCH = ".onnx", ".pt2"
TARGET_SIZES = {"orig_target_sizes": "tensor(int64)"}
"""A second input of RT-DETR and D-FINE: width and height to which boxes are scaled, [N, 2]."""
PICKLES = (".pt", ".pth", ".ckpt", ".pkl", ".pickle", ".torchscript")
"""Endings of files that hold pickles, which are programs. They are never opened."""


@dataclass(frozen=True, kw_only=True)
class DetectorFile(Foreign):
    """Your own detector as an ONNX (.onnx) or torch.export (.pt2) file. Nothing in the file is executed.

    A .pt2 file has gradients for white-box attacks. An .onnx file has none: attacks that need gradients are refused. It needs
    ONNX Runtime: pip install 'cavbench[onnx]'.

    The input is images [N, 3, H, W] or [N, H, W, 3]; N, H and W are fixed in the file or dynamic. To a fixed size, images are
    fitted with a grey border. The output has a fixed number of predictions, in one of the layouts of docs/victims/detector.md.

    Args:
        path: the file.
    """

    path: str

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.path.endswith((ONNX, TORCH)):
            raise ValueError(f"path must end with {ONNX} or {TORCH}, got {short(self.path)!r}{_instead(self.path)}")
        if self.path.endswith(ONNX):
            # Both depend on the file's format.
            object.__setattr__(self, "answers", "scores")
            object.__setattr__(self, "libraries", (onnx_runtime.LIBRARY,))

    def load(self, seed: int, facts: Facts) -> FileDetector:
        """The detector in the file, the same for any seed.

        Raises:
            UserError: if the file is missing, cannot be read, is not a detector or does not match the other parameters.
        """
        names, sha256 = self.class_names(), hashed(self.path, "detector")
        if names:
            sha256 = hashlib.sha256("\n".join((sha256, *names)).encode()).hexdigest()
        refuse_harm(self.path, _check, self, names, sha256)
        return self.read(_check(self, names, sha256), sha256)

    def read(self, names: tuple[str, ...] | None, sha256: str) -> FileDetector:
        """The detector, not tried yet; without class names if they are None.

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
        given = self.input_of(self.path, shape, dtype)
        return FileDetector(network, self.path, names or (), given, self.output, sha256)


def _instead(path: str) -> str:
    """What to type instead of a file in another format."""
    name = Path(path).name
    if path.endswith(PICKLES):
        stem = short(name.rpartition(".")[0])
        five = (
            f"; a file of release 6.0 or later is victim=yolov5 victim.path={short(name)}" if "yolov5" in name else ""
        )
        return (
            f": it holds a pickle, which is a program and is never opened. With Ultralytics' own command, `yolo export "
            f"model={short(name)} format=onnx imgsz=384,1248` writes {stem}.onnx; of your own module, torch.export.save writes a "
            f"{TORCH}{five}"
        )
    if path.endswith(".json"):
        return ": a TensorFlow.js graph is victim=tfjs"
    return f": export the detector to {ONNX}, which most tools can"


def _onnx(path: Path, name: str, sha256: str) -> tuple[Network, tuple[int | None, ...], torch.dtype, str]:
    types = onnx_runtime.TYPES | onnx_runtime.BYTES
    model = onnx_runtime.read(path, name, sha256, types, TARGET_SIZES)
    last = len(model.shape) == 4 and model.shape[3] == 3
    # Where boxes and scores have one shape, boxes come first.
    order = sorted(range(len(model.outputs)), key=lambda number: "box" not in model.outputs[number].lower())
    outputs, whole = [model.outputs[number] for number in order], [model.whole[number] for number in order]

    def network(pictures: Tensor) -> list[Tensor]:
        rows, columns = pictures.shape[1:3] if last else pictures.shape[2:]
        size = torch.tensor([[columns, rows]]).expand(len(pictures), -1).contiguous()
        found = model.run(pictures, outputs, **dict.fromkeys(model.others, size))
        return [one.long() if is_whole else one for one, is_whole in zip(found, whole, strict=True)]

    return network, model.shape, model.dtype, model.sha256


def _torch(path: Path, name: str, sha256: str) -> tuple[Network, tuple[int | None, ...], torch.dtype, str]:
    program = torch_program.read(path, name)
    if program.dtype not in (torch.float32, torch.float16):
        raise UserError(f"{name} takes {program.dtype or 'an unknown type'}; a detector takes float32 or float16")
    return program.graph, program.shape, program.dtype, sha256


@cache
def _check(victim: DetectorFile, names: tuple[str, ...] | None, sha256: str) -> tuple[str, ...]:
    """Try a file once in a process, and return the class names. Its kernels may crash on a crafted file.

    Raises:
        UserError: if it fails, or its predictions are not those of a detector.
    """
    detector = victim.read(names, sha256)
    gradient = look(victim, detector)
    if victim.answers == "gradients" and (gradient is None or not bool(gradient.any())):
        raise UserError(
            f"{victim.path} has no gradient from its scores to the pixels: export it without torch.no_grad, rounding and "
            "thresholds, or as .onnx to score it as a black box"
        )
    return detector.names
