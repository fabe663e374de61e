"""A driver from an ONNX file, evaluated with ONNX Runtime. It is a black box without gradients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from cavbench.core.contracts import Access
from cavbench.driving import DrivingFacts
from cavbench.driving.victims.from_file import FileDriver, FilePolicy
from cavbench.errors import UserError
from cavbench.formats import onnx_runtime


@dataclass(frozen=True, kw_only=True)
class ONNX(FileDriver):
    """Your own policy as an ONNX file. It has no gradients: attacks that need gradients are refused.

    Its first output maps observations [batch, rows, features], flattened or not, to scores or actions. The batch size must be
    dynamic. Tensors in other files are read from the folder of the model only. Needs ONNX Runtime: pip install 'cavbench[onnx]'.
    """

    answers: ClassVar[Access] = "scores"
    format: ClassVar[str] = "an ONNX model"

    def read(self, path: Path, sha256: str, facts: DrivingFacts) -> FilePolicy:
        model = onnx_runtime.read(path, self.path, sha256)
        batch, *shape = model.shape
        native = self.fitted(facts, shape)
        if batch is not None:
            raise UserError(f"{self.path} has a fixed batch size of {batch}: export it with a dynamic first axis")

        sizes = [side for side in shape if side is not None]
        self._check_outputs(model, sizes, self.width(facts))

        def network(observation: Tensor) -> Tensor:
            return model.run(observation, model.outputs[:1])[0]

        return FilePolicy(network, sizes, self.action_type, self.width(facts), model.sha256, native=native)

    def _check_outputs(self, model: onnx_runtime.Model, shape: Sequence[int], width: int) -> None:
        """Refuse a file that does not say which output drives, such as a mean and a standard deviation, or two critics."""
        if len(model.outputs) < 2:
            return
        answers = model.run(torch.zeros(2, *shape), model.outputs)
        fitting = [name for name, one in zip(model.outputs, answers, strict=True) if list(one.shape) == [2, width]]
        if len(fitting) > 1:
            raise UserError(
                f"{self.path} returns {' and '.join(fitting)} of {width} numbers each: export the one that drives alone, "
                "squashed as the policy squashes it"
            )
