"""A driver from an ONNX file, evaluated with ONNX Runtime. It is a black box without gradients."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from bench.errors import UserError
from bench.plugins.contracts import Access
from bench.victims.drivers.from_file import FileDriver, FilePolicy, OperationError
from bench.victims.drivers.onnx_file import companions


@dataclass(frozen=True, kw_only=True)
class ONNX(FileDriver):
    """Your own policy as an ONNX file. It has no gradients: attacks that need gradients are refused.

    Its first output maps observations [batch, rows, features], flattened or not, to scores or actions. The batch size must be
    dynamic. Tensors in other files are read from the folder of the model only. Needs ONNX Runtime: pip install 'cavbench[onnx]'.
    """

    answers: ClassVar[Access] = "scores"
    format: ClassVar[str] = "an ONNX model"

    def read(self, path: Path, sha256: str, width: int) -> FilePolicy:
        try:
            import onnxruntime
        except ImportError:
            raise UserError("victim 'onnx' needs ONNX Runtime: pip install 'cavbench[onnx]'") from None
        for file in companions(path, self.path):
            sha256 = hashlib.sha256((sha256 + hashlib.sha256(file.read_bytes()).hexdigest()).encode()).hexdigest()
        onnxruntime.disable_telemetry_events()
        # Its own complaints would go to standard error beside ours.
        onnxruntime.set_default_logger_severity(4)
        options = onnxruntime.SessionOptions()
        options.add_session_config_entry("session.load_model_format", "ONNX")
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        inputs = session.get_inputs()
        if len(inputs) != 1 or inputs[0].type != "tensor(float)":
            types = ", ".join(f"{one.name} {one.type}" for one in inputs)
            raise UserError(f"{self.path} takes {types}; a driver takes one tensor(float), the observation")
        batch, *shape = inputs[0].shape
        self.check_observation(shape)
        if isinstance(batch, int):
            raise UserError(f"{self.path} has a fixed batch size of {batch}: export it with a dynamic first axis")
        name, output = inputs[0].name, session.get_outputs()[0].name

        def network(observation: Tensor) -> Tensor:
            try:
                (answer,) = session.run([output], {name: observation.detach().cpu().contiguous().numpy()})
            # ONNX Runtime has many exceptions; their text names the operation.
            except Exception as error:
                node = re.search(r"running (\w+) node", str(error))
                raise OperationError(node[1]) if node else error from error
            return torch.from_numpy(answer).to(observation.device)

        return FilePolicy(network, shape, self.action_type, width, sha256)
