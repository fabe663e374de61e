#!/usr/bin/env bash
# One guesses: OpenCV reads a Resize by the rules of the opset that the model names.
# What happens: a bilinear Resize of opset 10, which counts pixels from their corners, is computed as one of opset 11
# and later, from their centres: up to half a pixel away. ONNX Runtime and OpenVINO compute what the model says.
# Versions: OpenCV 5.0.0, onnxruntime 1.32.0. Source: the ONNX operator Resize, opsets 10 and 11.
source "$(dirname "$0")/fresh.sh"
fresh numpy==2.4.6 onnx==1.23.2 onnxruntime==1.32.0 opencv-python-headless==5.0.0.93
see <<'P'
import cv2
import numpy as np
from onnx_model import model, onnx_runtime, opencv

shapes, scales = ([("x", [1, 1, 4, 4])], [("y", [1, 1, 8, 8])]), {"scales": np.float32([1, 1, 2, 2])}
ten = model("Resize", *shapes, scales, 10, names=["x", "scales"], mode="linear")
thirteen = model("Resize", *shapes, scales, 13, names=["x", "", "scales"], mode="linear")
x = np.arange(16, dtype=np.float32).reshape(1, 1, 4, 4)
meant, centres, found = onnx_runtime(ten, x=x)[0], onnx_runtime(thirteen, x=x)[0], opencv(ten, x)
print("OpenCV", cv2.__version__, found[0, 0, 0].tolist(), "and ONNX Runtime", meant[0, 0, 0].tolist())
assert float(abs(found - meant).max()) > 1
assert float(abs(found - centres).max()) < 1e-5
P
