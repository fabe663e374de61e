#!/usr/bin/env bash
# One guesses: a session that is made from bytes knows no folder, so a model whose tensors lie in another file cannot be loaded from bytes.
# What happens: without graph optimisation the tensors are read from the working folder of the process. The same bytes are another network in
# another folder. With the default optimisation this model raises an error.
# Versions: onnxruntime 1.32.0, onnx 1.23.2. Source: a hash of a model's bytes that did not tell two networks apart.
source "$(dirname "$0")/fresh.sh"
fresh onnxruntime==1.32.0 onnx==1.23.2 numpy
see <<'P'
import os

import numpy as np
import onnx
import onnxruntime
from onnx import TensorProto, helper

weight = helper.make_tensor("weight", TensorProto.FLOAT, [2, 2], np.zeros(4, np.float32).tobytes(), raw=True)
weight.ClearField("raw_data")
weight.data_location = TensorProto.EXTERNAL
for key, value in {"location": "weight.bin", "offset": "0", "length": "16"}.items():
    entry = weight.external_data.add()
    entry.key, entry.value = key, value
graph = helper.make_graph(
    [helper.make_node("MatMul", ["given", "weight"], ["answer"])],
    "product",
    [helper.make_tensor_value_info("given", TensorProto.FLOAT, [1, 2])],
    [helper.make_tensor_value_info("answer", TensorProto.FLOAT, [1, 2])],
    [weight],
)
model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10).SerializeToString()
answers = []
for number in (1, 2):
    os.mkdir(f"folder{number}")
    os.chdir(f"folder{number}")
    np.full(4, number / 2, np.float32).tofile("weight.bin")
    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    answers.append(float(session.run(None, {"given": np.ones((1, 2), np.float32)})[0][0, 0]))
    os.chdir("..")
print(f"onnxruntime {onnxruntime.__version__}: the same bytes answer {answers} in two folders")
raise SystemExit(answers != [1.0, 2.0])
P
