"""A driver exported with `torch.export`: a graph of tensor operations, without its original code."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import torch
from annotated_types import Ge
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from cavbench.driving import DrivingFacts
from cavbench.driving.victims.from_file import FileDriver, FilePolicy, Typed
from cavbench.driving.victims.remembering import BEGUN, Memory, RememberingPolicy
from cavbench.errors import UserError
from cavbench.formats.torch_graph import Graph, Single
from cavbench.formats.torch_program import Program, Value, read


@dataclass(frozen=True, kw_only=True)
class TorchExport(FileDriver):
    """Your own policy, written by `torch.export.save`. It has gradients for white-box attacks.

    It maps observations [batch, rows, features], flattened or not, to scores or actions. The batch size must be dynamic
    (`torch.export.Dim`). Nothing in the file is executed: a file with anything but tensors and operations of ATen is refused.

    A recurrent policy also takes its memory, and returns it after its answer: tensors of the same shapes in the same order, which
    are 0 before the first decision. A bool input is true at the first decision of an episode (`is_init`).

    Args:
        output: number of the output that drives, from 0; None if only one can.
    """

    format: ClassVar[str] = "a program of torch.export.save"

    output: Annotated[int, Ge(0)] | None = None

    def read(self, path: Path, sha256: str, facts: DrivingFacts) -> FilePolicy:
        program = read(path, self.path, several=True)
        seen, marks, memory = self._inputs(program)
        output = self._driving(program, self.width(facts))
        batch, *shape = program.inputs[seen].shape
        native = self.fitted(facts, shape)
        if batch is not None:
            raise UserError(
                f"{self.path} has a fixed batch size of {batch}: export it with "
                'dynamic_shapes={"observation": {0: torch.export.Dim("batch")}}'
            )
        options: dict[str, Any] = {
            "shape": [side for side in shape if side is not None],
            "action_type": self.action_type,
            "width": self.width(facts),
            "sha256": sha256,
            "native": native,
        }
        dtype = self._precision(program.inputs[seen])
        if len(program.inputs) == 1:
            return FilePolicy(Typed(Single(program.graph, output), dtype), **options)
        network = Recurrent(program, seen, marks, memory, output, self._after(program, memory, output))
        return RememberingPolicy(network, network.memory, **options)

    def _precision(self, observation: Value) -> torch.dtype:
        if observation.dtype is None or not observation.dtype.is_floating_point:
            raise UserError(f"{self.path} takes observations of {observation.dtype}: export it for torch.float32")
        return observation.dtype

    def _inputs(self, program: Program) -> tuple[int, list[int], list[int]]:
        """The number of the observation among the inputs, of the marks of a first decision, and of the memory."""
        inputs = program.inputs
        named = [place for place, one in enumerate(inputs) if one.name == "observation"]
        seen = named[0] if named else 0
        marks = [place for place, one in enumerate(inputs) if place != seen and one.dtype == torch.bool]
        memory = [place for place in range(len(inputs)) if place not in (seen, *marks)]
        for place in (*marks, *memory):
            one = inputs[place]
            fits = (
                one.shape in ((None,), (None, 1))
                if place in marks
                else one.dtype is not None and one.dtype.is_floating_point and one.shape.count(None) == 1
            )
            if not fits:
                raise UserError(
                    f"{self.path} takes {one.name}, {one}; besides its observation a driver takes its memory, numbers with one "
                    "axis of any size, the batch, and bool [batch] or [batch, 1] for the first decision"
                )
        return seen, marks, memory

    def _driving(self, program: Program, width: int) -> int:
        """The number of the output that drives."""
        returned = program.outputs
        listed = "; ".join(f"{number}: {one}" for number, one in enumerate(returned))
        if self.output is not None and self.output >= len(returned):
            raise UserError(f"victim.output={self.output}, but {self.path} returns {listed}")
        if self.output is not None or len(returned) == 1:
            return self.output or 0
        fitting = [
            number
            for number, one in enumerate(returned)
            if one.shape == (None, width) and one.dtype is not None and one.dtype.is_floating_point
        ]
        if len(fitting) != 1:
            which = "which of these drives" if fitting else f"which has {width} real numbers for each observation"
            raise UserError(
                f"{self.path} returns {listed}. Say {which} with victim.output=…, or export it alone, for instance "
                f'actor.select_out_keys("{"action_value" if self.action_type == "discrete" else "action"}")'
            )
        return fitting[0]

    def _after(self, program: Program, memory: Sequence[int], output: int) -> list[int]:
        """The number of the output for each part of the memory: those of the same shape, in order."""
        given = [program.inputs[place] for place in memory]
        shapes = {one.shape for one in given}
        found = [place for place, one in enumerate(program.outputs) if place != output and one.shape in shapes]
        if [program.outputs[place].shape for place in found] != [one.shape for one in given]:
            raise UserError(
                f"{self.path} takes a memory of {', '.join(f'{one.name} {one}' for one in given)}, and does not return it in the "
                f"same order: it returns {'; '.join(map(str, program.outputs))}"
            )
        if lost := program.graph.unread():
            raise UserError(
                f"{self.path} does not read its input {lost[0]!r}. torch.export takes two example inputs that are one tensor "
                "for one input: export it again with a tensor of its own for each"
            )
        return found


class Recurrent(nn.Module):
    """A graph with a memory, as a module from observations and memory to its answer and the memory after it.

    Args:
        program: the program.
        seen: number of its input for the observation.
        marks: numbers of its inputs that are true at the first decision.
        given: numbers of its inputs for the memory.
        output: number of the output that drives.
        after: numbers of its outputs for the memory, in the order of `given`.
    """

    def __init__(
        self, program: Program, seen: int, marks: Sequence[int], given: Sequence[int], output: int, after: Sequence[int]
    ) -> None:
        super().__init__()
        self.graph: Graph = program.graph
        self.inputs = program.inputs
        self.seen, self.marks, self.output = seen, tuple(marks), output
        self.given, self.after = tuple(given), tuple(after)

    @property
    def memory(self) -> Memory:
        """What is remembered of an episode."""
        entries: dict[str, Any] = {BEGUN: ((), torch.bool)}
        for place in self.given:
            one = self.inputs[place]
            entries[f"memory{place}"] = tuple(side for side in one.shape if side is not None), one.dtype
        return entries

    def forward(self, observation: Tensor, memory: TensorDictBase) -> tuple[Tensor, TensorDictBase]:
        taken: dict[int, Tensor] = {self.seen: observation.to(self.inputs[self.seen].dtype)}
        for place in self.marks:
            first = ~memory[BEGUN]
            taken[place] = first if len(self.inputs[place].shape) == 1 else first.unsqueeze(-1)
        for place in self.given:
            # The batch is the first axis of a memory here, and any axis of the program's.
            taken[place] = memory[f"memory{place}"].movedim(0, self._batch(place)).contiguous()
        found = self.graph(*(taken[place] for place in range(len(self.inputs))))
        kept = {
            f"memory{place}": found[number].movedim(self._batch(place), 0)
            for place, number in zip(self.given, self.after, strict=True)
        }
        begun = torch.ones_like(memory[BEGUN])
        return found[self.output], TensorDict({BEGUN: begun, **kept}, batch_size=observation.shape[:1])

    def _batch(self, place: int) -> int:
        """The axis of the batch in a part of the memory."""
        return self.inputs[place].shape.index(None)
