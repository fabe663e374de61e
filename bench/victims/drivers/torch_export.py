"""A driver exported with `torch.export`: a graph of tensor operations, without its original code."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from bench.errors import UserError
from bench.victims.drivers.from_file import FileDriver, FilePolicy


@dataclass(frozen=True, kw_only=True)
class TorchExport(FileDriver):
    """Your own policy, written by `torch.export.save`. It has gradients for white-box attacks.

    It maps observations [batch, rows, features], flattened or not, to scores or actions. The batch size must be dynamic
    (`torch.export.Dim`).
    """

    def read(self, path: Path, sha256: str, width: int) -> FilePolicy:
        program = torch.export.load(path)
        inputs = program.graph_signature.user_inputs
        nodes = [node for node in program.graph.nodes if node.op == "placeholder" and node.name in inputs]
        if len(nodes) != 1:
            raise UserError(f"{self.path} takes {len(inputs)} inputs, a driver takes one: the observation")
        batch, *shape = nodes[0].meta["val"].shape
        self.check_observation(shape)
        if not isinstance(batch, torch.SymInt):
            raise UserError(
                f"{self.path} has a fixed batch size of {batch}: export it with "
                'dynamic_shapes={"observation": {0: torch.export.Dim("batch")}}'
            )
        return FilePolicy(program.module(), shape, self.action_type, width, sha256)
