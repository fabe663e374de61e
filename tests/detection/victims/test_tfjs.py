"""A detector in a graph of TensorFlow.js is scored like any other file."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from cavbench.detection.victims.file_network import FileDetector
from cavbench.envs.camera.world import StopSignApproach
from cavbench.errors import UserError
from cavbench.run.config import component
from tests.command import Said
from tests.detection.victims.test_from_file import NAMES, RedCells
from tests.formats.tfjs_graphs import attribute, conv

SIDE = 32


def detector_file(folder: Path, shape: tuple[int, ...] = (1, SIDE, SIDE, 3)) -> str:
    """`RedCells` as a graph: a convolution, its scores, and boxes that are constants."""
    network = RedCells()
    kernel = network.kernel.weight.detach().permute(2, 3, 1, 0).contiguous().numpy()
    tensors = {
        "kernel": kernel,
        "bias": network.kernel.bias.detach().numpy(),
        "rows": np.array([1, -1, 2], np.int32),
        "boxes": network.boxes[None].numpy(),
        "zero": np.float32(0),
        "all": np.array([1, 2, 3], np.int32),
    }
    dims = [{"size": str(side)} for side in shape]
    nodes = [
        {"name": "x", "op": "Placeholder", "attr": {"dtype": {"type": "DT_FLOAT"}, "shape": {"shape": {"dim": dims}}}},
        *[{"name": name, "op": "Const"} for name in tensors],
        {
            "name": "cells",
            "op": "_FusedConv2D",
            "input": ["x", "kernel", "bias"],
            "attr": {
                name: attribute(value) for name, value in conv("VALID", 8, fused_ops=["BiasAdd", "Sigmoid"]).items()
            },
        },
        {"name": "scores", "op": "Reshape", "input": ["cells", "rows"]},
        {"name": "mean", "op": "Mean", "input": ["x", "all"], "attr": {"keep_dims": attribute(False)}},
        {"name": "none", "op": "Mul", "input": ["mean", "zero"]},
        {"name": "placed", "op": "AddV2", "input": ["boxes", "none"]},
    ]
    entries = [
        {"name": name, "shape": list(one.shape), "dtype": "int32" if one.dtype == np.int32 else "float32"}
        for name, one in tensors.items()
    ]
    described = {
        "format": "graph-model",
        "modelTopology": {"node": nodes},
        "signature": {"outputs": {"a": {"name": "cells:0"}, "b": {"name": "scores:0"}, "c": {"name": "placed:0"}}},
        "weightsManifest": [{"paths": ["a.bin"], "weights": entries}],
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "model.json").write_text(json.dumps(described))
    (folder / "a.bin").write_bytes(b"".join(np.ascontiguousarray(one).tobytes() for one in tensors.values()))
    return str(folder / "model.json")


def load(path: str, **values: str) -> FileDetector:
    given = {"path": path, "names": NAMES, "frame": str(SIDE), "outputs": "scores+placed", **values}
    return component("victim", "tfjs", given).load(0, StopSignApproach().facts)


def test_it_predicts_like_the_network_with_its_gradient(tmp_path: Path) -> None:
    detector = load(detector_file(tmp_path))
    pictures = torch.rand(3, 3, SIDE, SIDE, generator=torch.Generator().manual_seed(0)).requires_grad_()
    boxes, scores = RedCells()(pictures)
    found = detector(pictures)
    torch.testing.assert_close(found.boxes, boxes)
    torch.testing.assert_close(found.scores, scores)
    own, wanted = (torch.autograd.grad(one.sum(), pictures)[0] for one in (found.scores, scores))
    torch.testing.assert_close(own, wanted)
    assert len(detector.weights_sha256) == 64


def test_what_does_not_fit_is_one_line(tmp_path: Path, bench: Callable[..., Said]) -> None:
    path = detector_file(tmp_path)
    with pytest.raises(UserError, match=r"has no output 'score'; it has cells, scores, placed"):
        load(path, outputs="score+placed")
    with pytest.raises(UserError, match=r"returns \[1, 3, 3, 2\] and \[1, 9, 2\] and \[1, 9, 4\] for 1 image"):
        load(path, outputs="")
    with pytest.raises(UserError, match=r"takes \[32, 32, 3\]; a detector takes images"):
        load(detector_file(tmp_path / "small", (SIDE, SIDE, 3)))
    said = bench("run", "attack=none", "victim=tfjs", "victim.path=net.onnx")
    assert (said.code, len(said.err.splitlines())) == (2, 1)
    assert "path must end with .json, got 'net.onnx'" in said.err


def test_its_hash_depends_on_its_weights(tmp_path: Path) -> None:
    first = load(detector_file(tmp_path / "one")).weights_sha256
    path = detector_file(tmp_path / "two")
    weights = Path(path).with_name("a.bin")
    weights.write_bytes(bytes([weights.read_bytes()[0] ^ 1]) + weights.read_bytes()[1:])
    assert load(path).weights_sha256 != first
