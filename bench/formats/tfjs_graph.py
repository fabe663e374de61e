"""A graph of TensorFlow.js as a module of torch, differentiable in its input. Nothing but a list of operations is carried out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from cavbench.errors import UserError, short
from cavbench.formats import tfjs_file
from cavbench.formats.tfjs_file import GraphFile, Node
from cavbench.formats.tfjs_operations import operation, parts
from cavbench.formats.tfjs_room import limited, room
from cavbench.formats.trial import OperationError, RefusedError

GIVEN, CONSTANT = ("Placeholder", "PlaceholderWithDefault"), "Const"
RESIZES = ("ResizeBilinear", "ResizeNearestNeighbor")
Value = tuple[str, int]


class Graph(nn.Module):
    """The nodes of a graph, carried out one after the other.

    Args:
        file: the graph.
        outputs: what it returns; None for what the file says.
        free: whether the input may have another size than the file says: images are then resized within the graph by the same
            ratios as at the size of the file.

    Raises:
        RefusedError: if it has other operations than are known, or another number of inputs than one.
    """

    shape: tuple[int | None, ...]
    """Of the input; None for a side of any size."""

    def __init__(self, file: GraphFile, outputs: Sequence[Value] | None = None, *, free: bool = False) -> None:
        super().__init__()
        self.outputs = tuple(outputs or file.outputs)
        self.steps = _needed(file, [name for name, _ in self.outputs])
        inputs = [node for node in self.steps if node.operation in GIVEN]
        if len(inputs) != 1:
            raise RefusedError(f"it takes {len(inputs)} inputs, it must take one")
        self.given = inputs[0].name
        self.shape = _shape(inputs[0])
        self.places: dict[str, str] = {}
        for node in self.steps:
            if node.operation == CONSTANT:
                if node.name not in file.weights:
                    raise RefusedError(f"its constant {node.name[:60]!r} is not among its weights")
                self.places[node.name] = place = f"weight_{len(self.places)}"
                self._keep(place, file.weights[node.name])
            elif node.operation not in GIVEN:
                operation(node)
        self.last = {name: number for number, node in enumerate(self.steps) for name, _ in node.inputs}
        self.ratios: dict[str, tuple[float, float]] = {}
        if free:
            sample = torch.zeros([side or 1 for side in self.shape])
            with torch.no_grad():
                self._run(sample, self.ratios)

    def _keep(self, place: str, weight: Tensor) -> None:
        """Numbers can be trained further; sizes and places can not."""
        if weight.is_floating_point() and weight.ndim:
            self.register_parameter(place, nn.Parameter(weight, requires_grad=False))
        else:
            self.register_buffer(place, weight)

    def forward(self, given: Tensor) -> tuple[Tensor, ...]:
        """The outputs.

        Raises:
            RefusedError: if a value is too large.
            OperationError: if an operation fails.
        """
        return self._run(given, None)

    def _run(self, given: Tensor, ratios: dict[str, tuple[float, float]] | None) -> tuple[Tensor, ...]:
        """The outputs; notes the ratios by which images are resized if asked to."""
        values: dict[Value, Tensor] = {}
        kept = {name for name, _ in self.outputs}
        with limited(given.numel()):
            for number, node in enumerate(self.steps):
                if node.name == self.given:
                    found: Sequence[Tensor] = (given,)
                elif node.name in self.places:
                    found = (getattr(self, self.places[node.name]),)
                else:
                    found = self._result(node, [_taken(values, one) for one in node.inputs], ratios)
                for place, one in enumerate(found):
                    values[node.name, place] = one
                # What nobody takes any more is dropped.
                for name in {name for name, _ in node.inputs if self.last[name] == number} - kept:
                    for key in [key for key in values if key[0] == name]:
                        del values[key]
            return tuple(_taken(values, one) for one in self.outputs)

    def _result(
        self, node: Node, taken: list[Tensor], ratios: dict[str, tuple[float, float]] | None
    ) -> Sequence[Tensor]:
        if node.operation in RESIZES and len(taken) == 2:
            sides = taken[0].shape[1:3]
            if ratios is not None:
                height, width = taken[1].tolist()
                ratios[node.name] = height / sides[0], width / sides[1]
            elif node.name in self.ratios:
                pairs = zip(sides, self.ratios[node.name], strict=True)
                taken[1] = torch.tensor([round(side * ratio) for side, ratio in pairs])
        try:
            found = parts(operation(node)(node, *taken))
        except (RefusedError, OperationError):
            raise
        except Exception as error:
            raise OperationError(f"{node.operation} ({node.name[:60]})") from error
        for one in found:
            room(one.shape)
        return found


def read(path: Path, name: str, outputs: Sequence[str] | None = None) -> tuple[Graph, str]:
    """The graph in a file, and the hash of the file with its weights.

    Args:
        path: `model.json`.
        name: its name in errors.
        outputs: names of some of its outputs, or of other values in it; None for all outputs.

    Raises:
        UserError: if it cannot be read, or is refused.
    """
    file = tfjs_file.read(path, name)
    try:
        values = None if outputs is None else [tfjs_file.value(one) for one in outputs]
        for other in [other for other, _ in values or () if other not in file.nodes]:
            listed = ", ".join(own for own, _ in file.outputs)
            raise UserError(f"{name} has no output {short(other)!r}; it has {short(listed)}")
        return Graph(file, values), file.sha256
    except RefusedError as error:
        raise UserError(f"{name} is refused: {error}") from error
    except (KeyError, ValueError, TypeError, AttributeError, IndexError, OverflowError) as error:
        raise UserError(f"{name} cannot be read: it is not a graph of TensorFlow.js, or a damaged one") from error


def _needed(file: GraphFile, outputs: Sequence[str]) -> list[Node]:
    """The nodes that the outputs need, in their order."""
    needed, left = set(outputs), list(outputs)
    while left:
        for name, _ in file.nodes[left.pop()].inputs:
            if name not in needed:
                needed.add(name)
                left.append(name)
    return [node for name, node in file.nodes.items() if name in needed]


def _shape(node: Node) -> tuple[int | None, ...]:
    """The shape of an input of numbers; -1 stands for any size."""
    kind = (node.attributes.get("dtype") or {}).get("type", "DT_FLOAT")
    if kind != "DT_FLOAT":
        raise RefusedError(f"it takes {str(kind)[:20]}; it must take DT_FLOAT")
    listed = node.attributes["shape"]["shape"].get("dim", ())
    sides = [int(side.get("size", -1)) for side in listed]
    return tuple(None if side == -1 else side for side in sides)


def _taken(values: dict[Value, Tensor], value: Value) -> Tensor:
    if value not in values:
        raise RefusedError(f"its node {value[0][:60]!r} has no result number {value[1]}")
    return values[value]
