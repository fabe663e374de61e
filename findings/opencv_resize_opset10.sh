#!/usr/bin/env bash
# One guesses: OpenCV reads a Resize by the rules of the opset that the model names.
# What happens: a bilinear Resize of opset 10, which counts pixels from their corners, is computed as one of opset 11
# and later, from their centres: up to half a pixel away. ONNX Runtime and OpenVINO compute what the model says.
# Versions: OpenCV 5.0.0, onnxruntime 1.32.0. Source: the ONNX operator Resize, opsets 10 and 11.
source "$(dirname "$0")/fresh.sh"
fresh numpy==2.4.6 onnx==1.23.2 onnxruntime==1.32.0 opencv-python-headless==5.0.0.93
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

import cv2


def opencv(made, x):
    onnx.save(made, "one.onnx")
    network = cv2.dnn.readNetFromONNX("one.onnx")
    network.setInput(x)
    return network.forward()


shapes, scales = ([("x", [1, 1, 4, 4])], [("y", [1, 1, 8, 8])]), {"scales": np.float32([1, 1, 2, 2])}
ten = model("Resize", *shapes, scales, 10, names=["x", "scales"], mode="linear")
thirteen = model("Resize", *shapes, scales, 13, names=["x", "", "scales"], mode="linear")
x = np.arange(16, dtype=np.float32).reshape(1, 1, 4, 4)
meant, centres, found = onnx_runtime(ten, x=x)[0], onnx_runtime(thirteen, x=x)[0], opencv(ten, x)
print("OpenCV", cv2.__version__, found[0, 0, 0].tolist(), "and ONNX Runtime", meant[0, 0, 0].tolist())
assert float(abs(found - meant).max()) > 1
assert float(abs(found - centres).max()) < 1e-5
P
