"""Reading a user's YOLOv5 checkpoint: the tensors are read, and no code in the file is executed."""

from __future__ import annotations

import copy
import hashlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from cavbench.detection.victims import yolov5_file
from cavbench.detection.victims.yolov5 import YOLOv5, YOLOv5Network
from cavbench.envs.camera.world import StopSignApproach
from cavbench.errors import UserError

FACTS = StopSignApproach().facts

COMMON = ("Conv", "Bottleneck", "C3", "SPPF", "Concat")
ORIGINAL = {"Convolution": "Conv", "Bottleneck": "Bottleneck", "C3": "C3", "SPPF": "SPPF", "Detect": "Detect"}


@pytest.fixture
def original(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Classes named as those of the original code, importable as long as a checkpoint is written."""
    models, common, yolo = (ModuleType(name) for name in ("models", "models.common", "models.yolo"))
    classes = SimpleNamespace()
    for module, names in ((common, COMMON), (yolo, ("Detect", "DetectionModel"))):
        for name in names:
            setattr(module, name, type(name, (nn.Module,), {"__module__": module.__name__}))
            setattr(classes, name, getattr(module, name))
    for module in (models, common, yolo):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    return classes


def disguised(module: nn.Module, classes: SimpleNamespace) -> nn.Module:
    """The same tree of tensors with the original's classes."""
    name = type(module).__name__
    other = getattr(classes, ORIGINAL[name])() if name in ORIGINAL else module
    for key, child in module.named_children():
        other._modules[key] = disguised(child, classes)
    other._parameters, other._buffers = module._parameters, module._buffers
    return other


@pytest.fixture
def network() -> YOLOv5Network:
    torch.manual_seed(0)
    return YOLOv5Network("n", ("stop sign", "car")).eval().half().float()


@pytest.fixture
def checkpoint(network: YOLOv5Network, original: SimpleNamespace, tmp_path: Path) -> Callable[..., Path]:
    """Write a network like the original code: half precision, 25 layers of its classes, in a dictionary."""

    def write(**changes: object) -> Path:
        layers = [original.Concat() for _ in range(25)]
        for number, layer in copy.deepcopy(network).half().model.items():
            layers[int(number)] = disguised(layer, original)
        layers[11] = nn.Upsample(scale_factor=2)
        model = original.DetectionModel()
        model.model = nn.Sequential(*layers)
        model.names = {0: "stop sign", 1: "car"}
        model.yaml = {"nc": 2, "depth_multiple": 0.33}
        model.stride = torch.tensor([8.0, 16, 32])
        whole = {"epoch": -1, "model": model, "ema": None, "best_fitness": np.float64(0.5), "opt": {"cfg": Path("x")}}
        path = tmp_path / "yolov5n.pt"
        torch.save(whole | changes, path)
        return path

    return write


def forget(monkeypatch: pytest.MonkeyPatch) -> None:
    """Remove the original's classes again."""
    for name in ("models", "models.common", "models.yolo"):
        monkeypatch.delitem(sys.modules, name)


def test_a_checkpoint_is_read_without_the_code_that_wrote_it(
    checkpoint: Callable[..., Path], network: YOLOv5Network, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = checkpoint()
    forget(monkeypatch)
    loaded = YOLOv5(path=str(path)).load(0, FACTS)
    pictures = torch.rand(1, 3, 64, 64)
    torch.testing.assert_close(loaded(pictures).scores, network(pictures).scores, rtol=0, atol=1e-5)
    torch.testing.assert_close(loaded(pictures).boxes, network(pictures).boxes, rtol=1e-4, atol=1e-2)
    assert loaded.names == ("stop sign", "car")
    assert loaded.weights_sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


def test_averaged_weights_are_preferred_and_old_files_have_a_list_of_names(
    checkpoint: Callable[..., Path], original: SimpleNamespace
) -> None:
    averaged = original.DetectionModel()
    averaged.names = ["bus"]
    averaged.register_buffer("only", torch.ones(3))
    read = yolov5_file.read(checkpoint(ema=averaged))
    assert read.names == ("bus",)
    assert list(read.tensors) == ["only"]


class Harm:
    """Unpickled in the ordinary way, it makes a file."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Callable[[str], int], tuple[str]]:
        return os.system, (f"touch {self.marker}",)


def test_a_checkpoint_with_an_unexpected_class_is_refused_and_not_executed(
    checkpoint: Callable[..., Path], tmp_path: Path
) -> None:
    marker = tmp_path / "ran"
    path = checkpoint(extra=Harm(marker))
    with pytest.raises(UserError, match=r"yolov5n\.pt are refused: they name posix\.system$"):
        yolov5_file.read(path)
    assert not marker.exists()
    torch.load(path, weights_only=False)
    assert marker.exists(), "the file is harmless, so this test shows nothing"


def test_a_class_with_an_expected_name_is_not_executed(
    checkpoint: Callable[..., Path], original: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran = []
    path = checkpoint()
    for kind in vars(original).values():
        monkeypatch.setattr(kind, "__setstate__", lambda self, state: ran.append(state), raising=False)
        monkeypatch.setattr(kind, "__new__", lambda kind: ran.append(kind), raising=False)
    assert yolov5_file.read(path).tensors
    assert not ran


@pytest.mark.parametrize("share", [0.0, 0.001, 0.5, 0.999])
def test_a_truncated_file_is_refused_in_one_line(checkpoint: Callable[..., Path], share: float) -> None:
    path = checkpoint()
    blob = path.read_bytes()
    path.write_bytes(blob[: int(share * len(blob))])
    assert_refused(path)


@pytest.mark.parametrize("content", [{"model": 3}, {}, [1, 2], torch.zeros(3)])
def test_a_checkpoint_of_something_else_is_refused_in_one_line(content: object, tmp_path: Path) -> None:
    path = tmp_path / "other.pt"
    torch.save(content, path)
    assert_refused(path)


@pytest.mark.parametrize("name", ["missing.pt", "missing.safetensors", "."])
def test_a_missing_file_is_refused_in_one_line(name: str, tmp_path: Path) -> None:
    assert_refused(tmp_path / name)


def test_a_safetensors_file_without_names_is_refused(tmp_path: Path) -> None:
    save_file({"x": torch.zeros(3)}, tmp_path / "other.safetensors")
    assert_refused(tmp_path / "other.safetensors")


def assert_refused(path: Path) -> None:
    with pytest.raises(UserError, match=r"cannot be read: |is refused: it is a folder") as error:
        yolov5_file.read(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)
