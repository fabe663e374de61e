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
import onnx
from onnx import TensorProto, helper, numpy_helper


def model(operation, inputs, outputs, constants, opset, types=(), **attributes):
    """A model of one operation; shapes of its inputs by name."""
    kinds = dict(types)
    values = [
        [helper.make_tensor_value_info(name, kinds.get(name, TensorProto.FLOAT), shape) for name, shape in part]
        for part in (inputs, outputs)
    ]
    names = attributes.pop("names")
    nodes = [helper.make_node(operation, names, [name for name, _ in outputs], **attributes)]
    kept = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    graph = helper.make_graph(nodes, "one", *values, kept)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8)


def onnx_runtime(made, **given):
    import onnxruntime

    onnxruntime.set_default_logger_severity(3)
    session = onnxruntime.InferenceSession(made.SerializeToString(), providers=["CPUExecutionProvider"])
    return session.run(None, given)


def openvino(made, **given):
    import openvino

    onnx.save(made, "one.onnx")
    core = openvino.Core()
    compiled = core.compile_model(core.read_model("one.onnx"), "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    found = compiled(given)
    return [found[one] for one in compiled.outputs]

import cv2


def opencv(made, x):
    onnx.save(made, "one.onnx")
    network = cv2.dnn.readNetFromONNX("one.onnx")
    network.setInput(x)
    return [network.forward()]


def shrink(**attributes):
    return model(
        "Resize", [("x", [1, 1, 64, 64])], [("y", [1, 1, 16, 16])], {"size": np.array([1, 1, 16, 16])}, 18,
        names=["x", "", "", "size"], mode="linear", **attributes,
    )


x = np.random.default_rng(0).random((1, 1, 64, 64), dtype=np.float32)
smooth, plain = (onnx_runtime(one, x=x)[0] for one in (shrink(antialias=1), shrink()))
found = {"openvino": openvino(shrink(antialias=1), x=x)[0], "opencv": opencv(shrink(antialias=1), x)[0]}
far, near = ({name: round(float(abs(one - other).max()), 4) for name, one in found.items()} for other in (smooth, plain))
print("with antialias=1, largest difference to ONNX Runtime with it", far, "and without", near)
assert min(far.values()) > 0.2
assert max(near.values()) < 1e-4
P
