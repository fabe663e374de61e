"""A driver exported with `torch.export`: a graph of tensor operations, without its original code."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor, nn

from cavbench.driving import DrivingFacts
from cavbench.driving.victims.from_file import FileDriver, FilePolicy
from cavbench.errors import UserError
from cavbench.formats.torch_graph import Single
from cavbench.formats.torch_program import read


@dataclass(frozen=True, kw_only=True)
class TorchExport(FileDriver):
    """Your own policy, written by `torch.export.save`. It has gradients for white-box attacks.

    It maps observations [batch, rows, features], flattened or not, to scores or actions. The batch size must be dynamic
    (`torch.export.Dim`). Nothing in the file is executed: a file with anything but tensors and operations of ATen is refused.
    """

    format: ClassVar[str] = "a program of torch.export.save"

    def read(self, path: Path, sha256: str, facts: DrivingFacts) -> FilePolicy:
        program = read(path, self.path)
        if (count := len(program.graph.outputs)) != 1:
            raise UserError(f"{self.path} returns {count} values, a driver returns one tensor")
        batch, *shape = program.shape
        native = self.fitted(facts, shape)
        if batch is not None:
            raise UserError(
                f"{self.path} has a fixed batch size of {batch}: export it with "
                'dynamic_shapes={"observation": {0: torch.export.Dim("batch")}}'
            )
        if program.dtype is None or not program.dtype.is_floating_point:
            raise UserError(f"{self.path} takes observations of {program.dtype}: export it for torch.float32")
        network = Typed(Single(program.graph), program.dtype)
        sizes = [side for side in shape if side is not None]
        return FilePolicy(network, sizes, self.action_type, self.width(facts), sha256, native=native)


class Typed(nn.Module):
    """A network that is given its input as numbers of its own precision.

    Args:
        network: the network.
        dtype: what it takes.
    """

    def __init__(self, network: nn.Module, dtype: torch.dtype) -> None:
        super().__init__()
        self.network, self.dtype = network, dtype

    def forward(self, observation: Tensor) -> Tensor:
        answer: Tensor = self.network(observation.to(self.dtype))
        return answer
