#!/usr/bin/env bash
# One guesses: onnx.version_converter keeps what a model computes.
# What happens: a Resize of opset 10 counts pixels from their corners; from opset 11 on the default counts from their
# centres. The converter adds no attribute, so after a conversion from 10 to 13 every bilinear Resize is shifted by up
# to half a pixel, without a word. An older detector that is brought to a newer opset has other feature maps, and its
# boxes move. (RoiAlign, whose centres changed too, is converted rightly.)
# Versions: onnx 1.23.2, onnxruntime 1.32.0. Source: onnx/version_converter/adapters/resize_10_11.h.
source "$(dirname "$0")/fresh.sh"
fresh numpy==2.4.6 onnx==1.23.2 onnxruntime==1.32.0
see <<'P'
import numpy as np
import onnx
from onnx_model import model, onnx_runtime

old = model(
    "Resize", [("x", [1, 1, 4, 4])], [("y", [1, 1, 8, 8])], {"scales": np.float32([1, 1, 2, 2])}, 10, names=["x", "scales"],
    mode="linear",
)
new = onnx.version_converter.convert_version(old, 13)
x = np.arange(16, dtype=np.float32).reshape(1, 1, 4, 4)
(before,), (after,) = onnx_runtime(old, x=x), onnx_runtime(new, x=x)
print("onnx", onnx.__version__, "first row before", before[0, 0, 0].tolist(), "and after", after[0, 0, 0].tolist())
assert [one.name for one in new.graph.node[-1].attribute] == ["mode"]
assert np.allclose(before[0, 0, 0, :4], [0, 0.5, 1, 1.5])
assert np.allclose(after[0, 0, 0, :4], [0, 0.25, 0.75, 1.25])
P
