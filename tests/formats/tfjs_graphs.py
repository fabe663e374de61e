"""Small graphs of TensorFlow.js, written as its converter writes them, and the input of each.

`python -m tests.formats.tfjs_graphs FOLDER` writes them for studies/tfjs_answers.js, which asks TensorFlow.js itself.
"""

from __future__ import annotations

import base64
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

SHAPE = (1, 5, 6, 4)
NODE = "answer"
Case = tuple[str, Mapping[str, Any], Sequence[Any]]
"""Operation, attributes, and inputs: None for the image, or a constant."""


def numbers(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def image(shape: Sequence[int] = SHAPE) -> np.ndarray:
    return numbers(*shape, seed=1)


def attribute(value: Any) -> dict[str, Any]:
    match value:
        case bool():
            return {"b": value}
        case int():
            return {"i": str(value)}
        case float():
            return {"f": value}
        case str() if value.startswith("DT_"):
            return {"type": value}
        case str():
            return {"s": base64.b64encode(value.encode()).decode()}
        case [str(), *_]:
            return {"list": {"s": [attribute(one)["s"] for one in value]}}
        case _:
            return {"list": {"i": [str(one) for one in value]}}


def conv(padding: str, stride: int = 1, dilation: int = 1, **others: Any) -> dict[str, Any]:
    steps, spread = [1, stride, stride, 1], [1, dilation, dilation, 1]
    return {"T": "DT_FLOAT", "padding": padding, "strides": steps, "dilations": spread, "data_format": "NHWC", **others}


def pool(padding: str, side: int, stride: int) -> dict[str, Any]:
    return {
        "T": "DT_FLOAT",
        "padding": padding,
        "ksize": [1, side, side, 1],
        "strides": [1, stride, stride, 1],
        "data_format": "NHWC",
    }


def fused(*words: str) -> dict[str, Any]:
    return {"fused_ops": list(words), "num_args": 1, "epsilon": 0.0}


def resize(*, align: bool = False, half: bool = False) -> dict[str, Any]:
    return {"align_corners": align, "half_pixel_centers": half}


def masks(**given: int) -> dict[str, Any]:
    return {f"{name}_mask": given.get(name, 0) for name in ("begin", "end", "ellipsis", "new_axis", "shrink_axis")}


def ints(*values: int) -> np.ndarray:
    return np.array(values, np.int32)


KERNEL, DEEP, BIAS = numbers(3, 3, 4, 3, seed=2), numbers(3, 3, 4, 2, seed=3), numbers(3, seed=4)
FOUR = [abs(numbers(4, seed=seed)) for seed in (7, 8, 9, 10)]
CASES: dict[str, Case] = {
    "conv, same, stride 2": ("Conv2D", conv("SAME", 2), [None, KERNEL]),
    "conv, valid, stride 2": ("Conv2D", conv("VALID", 2), [None, KERNEL]),
    "conv, same, dilated": ("Conv2D", conv("SAME", 1, 2), [None, KERNEL]),
    "conv, explicit": ("Conv2D", conv("EXPLICIT", 1, explicit_paddings=[0, 0, 1, 0, 2, 1, 0, 0]), [None, KERNEL]),
    "fused, relu6": ("_FusedConv2D", conv("SAME", **fused("BiasAdd", "Relu6")), [None, KERNEL, BIAS]),
    "fused, leaky": ("_FusedConv2D", conv("SAME", **fused("BiasAdd", "LeakyRelu"), leakyrelu_alpha=0.1), [None, KERNEL, BIAS]),
    "depthwise, same, stride 2": ("DepthwiseConv2dNative", conv("SAME", 2), [None, DEEP]),
    "fused depthwise": ("FusedDepthwiseConv2dNative", conv("SAME", **fused("BiasAdd", "Relu")), [None, DEEP, numbers(8, seed=5)]),
    "max pool, same": ("MaxPool", pool("SAME", 3, 2), [None]),
    "max pool, valid": ("MaxPool", pool("VALID", 2, 2), [None]),
    "average pool, same": ("AvgPool", pool("SAME", 3, 2), [None]),
    "bilinear, half pixels, up": ("ResizeBilinear", resize(half=True), [None, ints(9, 12)]),
    "bilinear, half pixels, down": ("ResizeBilinear", resize(half=True), [None, ints(2, 4)]),
    "bilinear, corners": ("ResizeBilinear", resize(align=True), [None, ints(9, 12)]),
    "bilinear, neither, up": ("ResizeBilinear", resize(), [None, ints(9, 12)]),
    "bilinear, neither, down": ("ResizeBilinear", resize(), [None, ints(2, 4)]),
    "nearest, up": ("ResizeNearestNeighbor", resize(), [None, ints(9, 12)]),
    "nearest, half pixels, down": ("ResizeNearestNeighbor", resize(half=True), [None, ints(2, 4)]),
    "pad": ("PadV2", {}, [None, np.array([[0, 0], [1, 2], [0, 3], [0, 0]], np.int32), np.float32(7)]),
    "mirror pad": ("MirrorPad", {"mode": "REFLECT"}, [None, np.array([[0, 0], [1, 2], [0, 3], [0, 0]], np.int32)]),
    "strided slice": ("StridedSlice", masks(begin=2, end=4), [None, ints(0, 3, 1, 2), ints(1, 5, 2, 3), ints(1, 2, 2, 1)]),
    "slice": ("Slice", {}, [None, ints(0, 1, 0, 2), ints(1, 3, -1, 1)]),
    "split": ("Split", {"num_split": 2}, [ints(3)[0], None]),
    "concatenate": ("ConcatV2", {"N": 2}, [None, numbers(1, 5, 6, 2), ints(3)[0]]),
    "transpose": ("Transpose", {}, [None, ints(0, 3, 1, 2)]),
    "reshape": ("Reshape", {"Tshape": "DT_INT32"}, [None, ints(1, -1, 4)]),
    "gather": ("GatherV2", {"batch_dims": 0}, [None, ints(2, 0, 2), ints(2)[0]]),
    "best": ("TopKV2", {"sorted": True}, [None, ints(2)[0]]),
    "mean": ("Mean", {"keep_dims": True}, [None, ints(1, 2)]),
    "greatest": ("Max", {"keep_dims": False}, [None, ints(-1)]),
    "softmax": ("Softmax", {}, [None]),
    "leaky": ("LeakyRelu", {"alpha": 0.1}, [None]),
    "slopes": ("Prelu", {}, [None, numbers(4, seed=6)]),
    "normalised": ("FusedBatchNormV3", {"epsilon": 0.01, "is_training": False}, [None, *FOUR]),
    "subtract": ("Sub", {}, [numbers(6, 1, seed=11), None]),
    "divide": ("RealDiv", {}, [None, numbers(4, seed=12)]),
    "remainder": ("FloorMod", {}, [None, np.float32(0.3)]),
    "greater": ("Greater", {}, [None, np.float32(0)]),
    "tile": ("Tile", {}, [None, ints(1, 2, 1, 1)]),
}  # fmt: skip


def model(case: Case, shape: Sequence[int] = SHAPE) -> tuple[dict[str, Any], bytes]:
    """`model.json` and its weights."""
    operation, attributes, inputs = case
    dims = [{"size": str(one)} for one in shape]
    given = {"dtype": {"type": "DT_FLOAT"}, "shape": {"shape": {"dim": dims}}}
    nodes: list[dict[str, Any]] = [{"name": "x", "op": "Placeholder", "attr": given}]
    content, entries, names = b"", [], []
    for number, one in enumerate(inputs):
        names.append("x" if one is None else f"constant_{number}")
        if one is not None:
            array = np.asarray(one)
            kind = "int32" if array.dtype == np.int32 else "float32"
            nodes.append(
                {
                    "name": names[-1],
                    "op": "Const",
                    "attr": {"dtype": {"type": "DT_INT32" if kind == "int32" else "DT_FLOAT"}},
                }
            )
            entries.append({"name": names[-1], "shape": list(array.shape), "dtype": kind})
            content += array.tobytes()
    made = {name: attribute(value) for name, value in {"T": "DT_FLOAT", **attributes}.items()}
    nodes.append({"name": NODE, "op": operation, "input": names, "attr": made})
    manifest = [{"paths": ["weights.bin"], "weights": entries}] if entries else []
    return {
        "format": "graph-model",
        "modelTopology": {"node": nodes, "library": {}, "versions": {}},
        "weightsManifest": manifest,
    }, content


def write(folder: Path, case: Case, shape: Sequence[int] = SHAPE) -> Path:
    """Write a graph, and return the path of its `model.json`."""
    folder.mkdir(parents=True, exist_ok=True)
    described, content = model(case, shape)
    (folder / "model.json").write_text(json.dumps(described))
    (folder / "weights.bin").write_bytes(content)
    return folder / "model.json"


if __name__ == "__main__":
    for name, case in CASES.items():
        write(Path(sys.argv[1]) / name, case)
    image().tofile(Path(sys.argv[1]) / "input.f32")
