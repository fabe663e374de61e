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
