#!/usr/bin/env bash
# One guesses: of equal scores TopK takes the one with the lower number first, as ONNX says.
# What happens: OpenVINO on the CPU takes others, and in another order: of 100 scores with ties one of the ten best is
# another prediction than in ONNX Runtime. An end-to-end detector that keeps its best 300 returns other boxes where
# scores tie, as they do after a quantisation and on flat images.
# Versions: onnxruntime 1.32.0, openvino 2026.4.1 (CPU, float32). Source: the ONNX operator TopK ("the element with
# the lower index will appear first").
source "$(dirname "$0")/fresh.sh"
fresh numpy==2.4.6 onnx==1.23.2 onnxruntime==1.32.0 openvino==2026.4.1
see <<'P'
import numpy as np
from onnx import TensorProto
from onnx_model import model, onnx_runtime, openvino

made = model(
    "TopK", [("x", [1, 100])], [("values", [1, 10]), ("places", [1, 10])], {"k": np.array([10])}, 17,
    [("places", TensorProto.INT64)], names=["x", "k"],
)
x = np.float32(np.arange(100) * 37 % 11)[None] / 10
(_, first), (_, second) = onnx_runtime(made, x=x), openvino(made, x=x)
print("onnxruntime", first[0].tolist(), "openvino", second[0].tolist())
assert first[0].tolist() == np.argsort(-x[0], stable=True)[:10].tolist()
assert set(second[0]) != set(first[0])
assert sorted(x[0, second[0]]) == sorted(x[0, first[0]])
P
