#!/usr/bin/env bash
# One guesses: a NaN among scores shows in their maximum, as in torch and numpy, and ArgMax points to it.
# What happens: ReduceMax keeps a NaN in the first place and drops it elsewhere, with 1 for a maximum of 3 here. MaxPool drops it everywhere,
# and ArgMax points elsewhere. So an exported policy with a NaN chooses an action as if nothing were wrong.
# Versions: onnxruntime 1.32.0, torch 2.13.0, on a processor with AVX2. Source: a policy with a division by zero that scored well as a file.
source "$(dirname "$0")/fresh.sh"
fresh onnxruntime==1.32.0 onnx==1.23.2 torch==2.13.0 numpy
see <<'P'
import numpy as np
import onnxruntime
import torch
from onnx import TensorProto, helper

OPERATIONS = {
    "ReduceMax": [helper.make_node("ReduceMax", ["x"], ["y"], keepdims=0)],
    "MaxPool": [helper.make_node("MaxPool", ["x"], ["y"], kernel_shape=[5])],
    "ArgMax": [helper.make_node("ArgMax", ["x"], ["place"], axis=2), helper.make_node("Cast", ["place"], ["y"], to=TensorProto.FLOAT)],
}


def answer(name, scores):
    given, wanted = (helper.make_tensor_value_info(one, TensorProto.FLOAT, None) for one in ("x", "y"))
    graph = helper.make_graph(OPERATIONS[name], "g", [given], [wanted])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return session.run(None, {"x": scores})[0].item()


def by_torch(name, scores):
    return float(scores.argmax() if name == "ArgMax" else scores.max())


seen = {}
for place in (0, 1):
    scores = np.float32([[[1, 2, 0.5, 3, 0]]])
    scores[..., place] = np.nan
    for name in OPERATIONS:
        seen[name, place] = answer(name, scores), by_torch(name, torch.from_numpy(scores))
print(f"onnxruntime {onnxruntime.__version__}: (ONNX Runtime, torch) of five scores with a NaN in place 0 or 1: {seen}")
lost = [key for key, (found, right) in seen.items() if not (np.isnan(found) and np.isnan(right)) and found != right]
raise SystemExit(lost != [("MaxPool", 0), ("ReduceMax", 1), ("MaxPool", 1), ("ArgMax", 1)] or seen["ReduceMax", 1][0] != 1)
P
