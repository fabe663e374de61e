"""A driver in an ONNX file: computed by ONNX Runtime, outside of torch, and so a black box."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from bench.errors import UserError
from bench.plugins.contracts import Access
from bench.victims.drivers.from_file import FileDriver, FilePolicy


@dataclass(frozen=True, kw_only=True)
class ONNX(FileDriver):
    """A policy of yours as an ONNX file. It has no gradients: attacks that need them are refused.

    It maps observations [batch, rows, features], or flattened ones, to scores or actions, its first output; its batch must be
    of any size. Needs ONNX Runtime: pip install 'cavbench[onnx]'.
    """

    answers: ClassVar[Access] = "scores"

    def read(self, path: Path, sha256: str, width: int) -> FilePolicy:
        try:
            import onnxruntime
        except ImportError:
            raise UserError("victim 'onnx' needs ONNX Runtime: pip install 'cavbench[onnx]'") from None
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        inputs = session.get_inputs()
        if len(inputs) != 1 or inputs[0].type != "tensor(float)":
            found = ", ".join(f"{one.name} {one.type}" for one in inputs)
            raise UserError(f"{self.path} takes {found}; a driver takes one tensor(float), the observation")
        batch, *shape = inputs[0].shape
        self.check_observation(shape)
        if isinstance(batch, int):
            raise UserError(f"{self.path} takes no batch but of {batch}: export it with a dynamic first axis")
        name, output = inputs[0].name, session.get_outputs()[0].name

        def network(observation: Tensor) -> Tensor:
            (answer,) = session.run([output], {name: observation.detach().contiguous().numpy()})
            return torch.from_numpy(answer)

        return FilePolicy(network, shape, self.action_type, width, sha256)
