#!/usr/bin/env bash
# One guesses: two boxes whose overlap equals the threshold of NonMaxSuppression get one answer from every library.
# What happens: ONNX Runtime keeps the second box (only more overlap than the threshold suppresses), OpenVINO drops
# it. Overlaps of exactly one half are common where boxes lie on a grid.
# Versions: onnxruntime 1.32.0, openvino 2026.4.1 (CPU, float32). Source: ONNX's text of iou_threshold does not say
# which.
source "$(dirname "$0")/fresh.sh"
fresh numpy==2.4.6 onnx==1.23.2 onnxruntime==1.32.0 openvino==2026.4.1
see <<'P'
import numpy as np
from onnx import TensorProto
from onnx_model import model, onnx_runtime, openvino

made = model(
    "NonMaxSuppression", [("boxes", [1, 2, 4]), ("scores", [1, 1, 2])], [("kept", [None, 3])],
    {"most": np.array([10]), "overlap": np.float32([0.5]), "least": np.float32([0])}, 17, [("kept", TensorProto.INT64)],
    names=["boxes", "scores", "most", "overlap", "least"],
)
given = {"boxes": np.float32([[[0, 0, 2, 1], [0, 0, 1, 1]]]), "scores": np.float32([[[0.9, 0.8]]])}
kept = {"onnxruntime": onnx_runtime(made, **given)[0][:, 2].tolist(), "openvino": openvino(made, **given)[0][:, 2].tolist()}
print("boxes kept at an overlap of exactly the threshold:", kept)
assert kept == {"onnxruntime": [0, 1], "openvino": [0]}
P
