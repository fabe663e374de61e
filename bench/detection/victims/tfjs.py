"""An object detector in a graph of TensorFlow.js of the user."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch

from cavbench.core.contracts import Facts
from cavbench.detection.victims.file_network import FileDetector
from cavbench.detection.victims.first_look import look
from cavbench.detection.victims.reading import Foreign
from cavbench.errors import UserError, short
from cavbench.formats import tfjs_graph
from cavbench.formats.trial import hashed, refuse_harm


@dataclass(frozen=True, kw_only=True)
class TensorFlowJS(Foreign):
    """Your own detector as a graph of TensorFlow.js: `model.json`, with the files of its weights beside it.

    The graph is read as data and carried out by torch, so it has gradients for white-box attacks. TensorFlow is not needed.

    Args:
        path: `model.json`.
        outputs: names of the outputs that are boxes, scores and labels, joined by `+`, if the graph has others.
    """

    path: str
    outputs: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.path.endswith(".json"):
            raise ValueError(
                f"path must end with .json, got {short(self.path)!r}: it is the file that tensorflowjs_converter names"
            )

    def load(self, seed: int, facts: Facts) -> FileDetector:
        """The detector in the file, the same for any seed.

        Raises:
            UserError: if a file is missing, cannot be read, is not a detector or does not match the other parameters.
        """
        names, sha256 = self.class_names(), hashed(self.path, "detector")
        refuse_harm(self.path, _check, self, names, sha256)
        return self.read(_check(self, names, sha256))

    def read(self, names: tuple[str, ...] | None) -> FileDetector:
        """The detector, not tried yet; without class names if they are None.

        Raises:
            UserError: if the files cannot be read, or its input is not one of images.
        """
        chosen = tuple(self.outputs.split("+")) if self.outputs else None
        graph, sha256 = tfjs_graph.read(Path(self.path).expanduser(), self.path, chosen)
        if names:
            sha256 = hashlib.sha256("\n".join((sha256, *names)).encode()).hexdigest()
        given = self.input_of(self.path, graph.shape, torch.float32)
        return FileDetector(graph, self.path, names or (), given, self.output, sha256)


@cache
def _check(victim: TensorFlowJS, names: tuple[str, ...] | None, sha256: str) -> tuple[str, ...]:
    """Try a graph once in a process, and return the class names.

    Raises:
        UserError: if it fails, or its predictions are not those of a detector.
    """
    detector = victim.read(names)
    gradient = look(victim, detector)
    if gradient is None or not bool(gradient.any()):
        raise UserError(
            f"{victim.path} has no gradient from its scores to the pixels: export it without rounding and thresholds"
        )
    return detector.names
