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
