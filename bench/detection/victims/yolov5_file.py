"""Read the weights of a YOLOv5 from a user's file without executing code from it or importing its classes.

A published `yolov5*.pt` is a pickled model with classes of the AGPL-3.0 training code, not a table of tensors. Torch's
restricted unpickler reads it with one inert class in place of all of them, which keeps the tree of tensors.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten

import torch
from safetensors import safe_open
from safetensors.torch import save as save_tensors
from torch import Tensor
from torch.serialization import get_unsafe_globals_in_checkpoint, safe_globals

from cavbench import bounded
from cavbench.archive import Archive
from cavbench.detection import Detector
from cavbench.errors import UserError
from cavbench.files import whole

EXPECTED = re.compile(
    r"models\.(yolo|common)\.\w+|torch\.nn\.modules\.\w+\.\w+"
    r"|pathlib\.(_local\.)?\w*Path|argparse\.Namespace|numpy\.(dtype|ndarray)|numpy\._?core\.multiarray\.(scalar|_reconstruct)"
)
"""Allowed class names in a checkpoint: the model's classes, and classes of the training's options and metrics."""


LARGEST_HEADER = 2**24
"""Most bytes of the JSON at the beginning of a .safetensors file."""


@dataclass(frozen=True)
class Weights:
    """The content of a file: tensors by their names in the state dict, class names, and the sha256 of the file."""

    tensors: dict[str, Tensor]
    names: tuple[str, ...]
    sha256: str


class _Inert:
    """Replaces every class of a checkpoint: stores its state and does nothing."""

    def __init__(self, *arguments: object) -> None:
        pass

    def __setstate__(self, state: object) -> None:
        if isinstance(state, dict):
            vars(self).update(state)


def read(path: Path) -> Weights:
    """Read a weights file: .safetensors as written by `save`, any other ending as a pickled checkpoint.

    Raises:
        UserError: if the file cannot be read, or names a class that is not `EXPECTED`.
    """
    try:
        sha256 = bounded.sha256(path, most=bounded.WEIGHTS, name=f"the weights {path}")
        tensors, names = _safetensors(path) if path.suffix == ".safetensors" else _checkpoint(path)
        return Weights(tensors, names, sha256)
    except UserError:
        raise
    except OSError as error:
        raise UserError(f"the weights {path} cannot be read: {error.strerror or error}") from error
    # A truncated or malicious file can fail anywhere in the unpickler.
    except Exception as error:
        raise UserError(
            f"the weights {path} cannot be read: the file is not a checkpoint of YOLOv5, or a damaged one"
        ) from error


def save(detector: Detector, path: Path) -> None:
    """Write the weights of a detector with unfolded batch normalisation, atomically, with its class names."""
    tensors = {name: tensor.contiguous() for name, tensor in detector.state_dict().items()}
    blob = save_tensors(tensors, metadata={"names": json.dumps(detector.names)})
    with whole(path) as file:
        file.write(blob)


def _safetensors(path: Path) -> tuple[dict[str, Tensor], tuple[str, ...]]:
    with path.open("rb") as start:
        if int.from_bytes(start.read(8), "little") > LARGEST_HEADER:
            raise UserError(f"the weights {path} are refused: their header has more than {LARGEST_HEADER >> 20} MiB")
    with safe_open(path, "pt") as file:
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        return tensors, _names(bounded.parsed((file.metadata() or {})["names"]))


def _checkpoint(path: Path) -> tuple[dict[str, Tensor], tuple[str, ...]]:
    copy = Archive.read(path, f"the weights {path}").repacked()
    named = get_unsafe_globals_in_checkpoint(copy)
    if unexpected := sorted(name for name in named if not EXPECTED.fullmatch(name)):
        raise UserError(f"the weights {path} are refused: they name {shorten(', '.join(unexpected), 200)}")
    with safe_globals([(_Inert, name) for name in named]):
        copy.seek(0)
        checkpoint = torch.load(copy, map_location="cpu", weights_only=True)
    model = isinstance(checkpoint, dict) and (checkpoint.get("ema") or checkpoint.get("model"))
    if not isinstance(model, _Inert):
        raise UserError(f"the weights {path} cannot be read: the file is not a checkpoint with a model")
    return dict(_tensors(model)), _names(vars(model)["names"])


def _tensors(module: _Inert, prefix: str = "") -> Iterator[tuple[str, Tensor]]:
    """The parameters and buffers of an inert module tree, with their names in the state dict."""
    state = vars(module)
    for name, tensor in {**state["_parameters"], **state["_buffers"]}.items():
        if tensor is not None:
            yield prefix + name, tensor
    for name, child in state["_modules"].items():
        yield from _tensors(child, f"{prefix}{name}.")


def _names(found: list[str] | dict[int, str]) -> tuple[str, ...]:
    """The class names: a list in older files, a dict by label in newer files."""
    return tuple(found[label] for label in range(len(found)))
