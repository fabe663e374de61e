#!/usr/bin/env bash
# One guesses: a MaxPool with ceil_mode has one size, in every library and in ONNX's own shape inference.
# What happens: with 7 pixels, windows of 2, steps of 2 and a border of 1, ONNX Runtime returns 4 x 4 (as torch does:
# no window begins in the border), OpenVINO returns 5 x 5, and ONNX's shape inference says 5 x 5. What is flattened
# after that has another number of predictions.
# Versions: onnx 1.23.2, onnxruntime 1.32.0, openvino 2026.4.1 (CPU). Source: the ONNX operator MaxPool, the formula
# of its output.
source "$(dirname "$0")/fresh.sh"
fresh numpy==2.4.6 onnx==1.23.2 onnxruntime==1.32.0 openvino==2026.4.1
see <<'P'
import numpy as np
import onnx
from onnx_model import model, onnx_runtime, openvino

made = model(
    "MaxPool", [("x", [1, 1, 7, 7])], [("y", None)], {}, 17, names=["x"], kernel_shape=[2, 2], strides=[2, 2], pads=[1] * 4,
    ceil_mode=1,
)
x = np.random.default_rng(0).random((1, 1, 7, 7), dtype=np.float32)
stated = onnx.shape_inference.infer_shapes(made).graph.output[0].type.tensor_type.shape.dim
sizes = {
    "shape inference": [one.dim_value for one in stated],
    "onnxruntime": list(onnx_runtime(made, x=x)[0].shape),
    "openvino": list(openvino(made, x=x)[0].shape),
}
print(sizes)
assert sizes == {"shape inference": [1, 1, 5, 5], "onnxruntime": [1, 1, 4, 4], "openvino": [1, 1, 5, 5]}
P
