#!/usr/bin/env bash
# One guesses: OpenVINO's preprocessing resizes images of bytes in floating point.
# What happens: a resize before convert_element_type returns whole numbers; after it, it does not. The two orders
# differ by half a grey level, and the first has no gradient that finite differences could find below one level.
# Versions: openvino 2026.4.1 (CPU, float32). Source: openvino.preprocess.
source "$(dirname "$0")/fresh.sh"
fresh numpy==2.4.6 onnx==1.23.2 openvino==2026.4.1
see <<'P'
import numpy as np
import onnx
import openvino
from onnx_model import model
from openvino.preprocess import PrePostProcessor, ResizeAlgorithm

same = model("Identity", [("x", [1, 1, 24, 24])], [("y", [1, 1, 24, 24])], {}, 17, names=["x"])
onnx.save(same, "one.onnx")
image = np.random.default_rng(0).integers(0, 256, (1, 1, 64, 64)).astype(np.uint8)
core = openvino.Core()


def resized(first):
    steps = PrePostProcessor(core.read_model("one.onnx"))
    layout = openvino.Layout("NCHW")
    steps.input().tensor().set_element_type(openvino.Type.u8).set_layout(layout).set_shape([1, 1, 64, 64])
    steps.input().model().set_layout(layout)
    part = steps.input().preprocess()
    if first == "convert":
        part.convert_element_type(openvino.Type.f32).resize(ResizeAlgorithm.RESIZE_LINEAR)
    else:
        part.resize(ResizeAlgorithm.RESIZE_LINEAR)
    compiled = core.compile_model(steps.build(), "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    return compiled({0: image})[compiled.outputs[0]]


whole = {first: bool((resized(first) == resized(first).round()).all()) for first in ("resize", "convert")}
difference = float(abs(resized("resize") - resized("convert")).max())
print("openvino", openvino.__version__.partition("-")[0], "whole numbers, by what comes first:", whole, f"difference {difference:.2f}")
assert whole == {"resize": True, "convert": False}
assert 0.3 < difference <= 0.5
P
