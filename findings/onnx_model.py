"""ONNX models of one operation, and runtimes that compute them: for the findings about exporters and runtimes of detectors."""

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
    """All outputs by ONNX Runtime."""
    import onnxruntime

    onnxruntime.set_default_logger_severity(3)
    session = onnxruntime.InferenceSession(made.SerializeToString(), providers=["CPUExecutionProvider"])
    return session.run(None, given)


def openvino(made, **given):
    """All outputs by OpenVINO, in float32 on the processor."""
    import openvino

    onnx.save(made, "one.onnx")
    core = openvino.Core()
    compiled = core.compile_model(core.read_model("one.onnx"), "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    found = compiled(given)
    return [found[one] for one in compiled.outputs]


def opencv(made, x):
    """The output by OpenCV's reader of ONNX files."""
    import cv2

    onnx.save(made, "one.onnx")
    network = cv2.dnn.readNetFromONNX("one.onnx")
    network.setInput(x)
    return network.forward()
