#!/usr/bin/env bash
# One guesses: after quantize_dynamic, a network answers a row by that row, as the network in floats did.
# What happens: activations are quantised by the range of the whole tensor, so a row's answer depends on the rows beside it. That moves
# answers as far as the quantisation itself. A score changes with the size of the batch.
# Versions: onnxruntime 1.32.0, onnx 1.23.2. torch 2.13.0 does the same in torch.ao.quantization.quantize_dynamic. Source: answers of networks in
# batches of 1 to 1,000; float32 answers of ONNX Runtime did not depend on the batch.
source "$(dirname "$0")/fresh.sh"
fresh numpy==2.4.6 onnx==1.23.2 onnxruntime==1.32.0
see <<'P'
import sys

sys.path.pop(0)  # ONNX Runtime's quantisation has a module onnx_model of its own.
import numpy as np
import onnx
import onnxruntime
from onnx import TensorProto, helper, numpy_helper
from onnxruntime.quantization import quantize_dynamic

rng = np.random.default_rng(0)
weights = [numpy_helper.from_array(rng.standard_normal(size).astype(np.float32) / 8, name) for name, size in (("w", (50, 64)), ("v", (64, 5)))]
nodes = [helper.make_node("MatMul", ["x", "w"], ["h"]), helper.make_node("Relu", ["h"], ["r"]), helper.make_node("MatMul", ["r", "v"], ["y"])]
ends = [[helper.make_tensor_value_info(name, TensorProto.FLOAT, [None, size])] for name, size in (("x", 50), ("y", 5))]
made = helper.make_model(helper.make_graph(nodes, "network", *ends, weights), opset_imports=[helper.make_opsetid("", 17)], ir_version=10)
onnx.save(made, "floats.onnx")
quantize_dynamic("floats.onnx", "quantised.onnx")
x = rng.standard_normal((200, 50)).astype(np.float32)


def answers(path, batch):
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    return np.concatenate([session.run(None, {"x": x[start : start + batch]})[0] for start in range(0, len(x), batch)])


moved = {path: float(abs(answers(path, 1) - answers(path, 200)).max()) for path in ("floats.onnx", "quantised.onnx")}
error = float(abs(answers("quantised.onnx", 1) - answers("floats.onnx", 1)).max())
print(f"onnxruntime {onnxruntime.__version__}: 1 row against 200 rows moves answers by {moved}; the quantisation alone by {error:.3f}")
raise SystemExit(not (moved["floats.onnx"] == 0 and moved["quantised.onnx"] > error / 2))
P
