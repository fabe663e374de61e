#!/usr/bin/env bash
# One guesses: a runtime that does not know antialias=1 of Resize refuses the model.
# What happens: OpenVINO and OpenCV read it, and resize without antialiasing; a shrunk image differs from ONNX
# Runtime's by a third of the range. A detector that shrinks its input within the graph sees another patch.
# Versions: onnxruntime 1.32.0, openvino 2026.4.1 (CPU, float32), OpenCV 5.0.0. Source: the ONNX operator Resize,
# opset 18.
source "$(dirname "$0")/fresh.sh"
fresh numpy==2.4.6 onnx==1.23.2 onnxruntime==1.32.0 openvino==2026.4.1 opencv-python-headless==5.0.0.93
see <<'P'
import numpy as np
from onnx_model import model, onnx_runtime, openvino, opencv


def shrink(**attributes):
    return model(
        "Resize", [("x", [1, 1, 64, 64])], [("y", [1, 1, 16, 16])], {"size": np.array([1, 1, 16, 16])}, 18,
        names=["x", "", "", "size"], mode="linear", **attributes,
    )


x = np.random.default_rng(0).random((1, 1, 64, 64), dtype=np.float32)
smooth, plain = (onnx_runtime(one, x=x)[0] for one in (shrink(antialias=1), shrink()))
found = {"openvino": openvino(shrink(antialias=1), x=x)[0], "opencv": opencv(shrink(antialias=1), x)}
far, near = ({name: round(float(abs(one - other).max()), 4) for name, one in found.items()} for other in (smooth, plain))
print("with antialias=1, largest difference to ONNX Runtime with it", far, "and without", near)
assert min(far.values()) > 0.2
assert max(near.values()) < 1e-4
P
