"""A program as a list of ATen operations, carried out one after the other. Nothing else can be called.

An operation is found by its name among those of `torch_operations`. Its arguments are values of the graph, numbers, types and
a few words, so that none can name a file or code.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch._ops import OpOverload

from cavbench.formats.torch_operations import operation
from cavbench.formats.trial import OperationError, RefusedError

DTYPES = {
    1: torch.uint8, 2: torch.int8, 3: torch.int16, 4: torch.int32, 5: torch.int64, 6: torch.float16, 7: torch.float32,
    8: torch.float64, 12: torch.bool, 13: torch.bfloat16,
}  # fmt: skip
"""The types of tensors, by their numbers in the format."""
FORMATS = {
    1: torch.contiguous_format, 2: torch.channels_last, 3: torch.channels_last_3d, 4: torch.preserve_format
}  # fmt: skip
STRIDED = 7
"""The number of the only layout that is read."""
WORDS = (
    "",
    "none",
    "tanh",
    "floor",
    "trunc",
    "lower",
    "left",
    "right",
    "ij",
    "xy",
    "mean",
    "sum",
    "prod",
    "amax",
    "amin",
    "constant",
    "reflect",
    "replicate",
)
"""Words that may be arguments, for instance how a division is rounded. Others could be names of files."""
ASSERTIONS = re.compile(r"torch\.ops\.aten\.(_assert_\w+|sym_constrain_range\w*)\.\w+")
"""Operations that check a size of the sample inputs; they compute nothing."""
NO_GRAD = "torch.ops.higher_order.wrap_with_set_grad_enabled"
NUMBERS: Mapping[str, Callable[..., Any]] = {
    **{f"_operator.{name}": getattr(operator, name) for name in ("add", "sub", "mul", "floordiv", "mod", "truediv", "neg")},
    **{f"_operator.{name}": getattr(operator, name) for name in ("eq", "ne", "lt", "le", "gt", "ge", "and_", "or_")},
    **{f"math.{name}": getattr(math, name) for name in ("ceil", "floor", "trunc")},
    "torch.sym_max": max,
    "torch.sym_min": min,
    "torch.sym_int": int,
    "torch.sym_float": float,
    "torch.sym_not": operator.not_,
}  # fmt: skip
"""Operations on sizes."""


@dataclass(frozen=True)
class Value:
    """An argument: a value that was computed before, by its name."""

    name: str


@dataclass(frozen=True)
class Device:
    """An argument: the device of the input, whatever the file says."""


@dataclass(frozen=True)
class Step:
    """An operation with its arguments, and the names of its results: one, a sequence of them, or None for no name."""

    name: str
    call: Callable[..., Any]
    args: tuple[Any, ...]
    kwargs: Mapping[str, Any]
    results: Any


class Graph(nn.Module):
    """The operations of a program as a module from its inputs to its outputs.

    Args:
        graph: `Graph` of the format.
        given: names of the inputs.
        weights: the tensors that the program computes with, by the names of their values.

    Raises:
        RefusedError: if it contains anything but operations of ATen.
    """

    def __init__(self, graph: Mapping[str, Any], given: Sequence[str], weights: Mapping[str, Tensor]) -> None:
        super().__init__()
        self.given = tuple(given)
        self.names = {f"weight_{number}": name for number, name in enumerate(weights)}
        for place, name in self.names.items():
            self.register_buffer(place, weights[name])
        self.steps = _steps(graph)
        self.outputs = [_tensor_name(value) for value in graph["outputs"]]

    def forward(self, *given: Tensor) -> tuple[Tensor, ...]:
        values: dict[str, Any] = {name: self._buffers[place] for place, name in self.names.items()}
        values |= dict(zip(self.given, given, strict=True))
        versions = self._versions()
        _run(self.steps, values, given[0].device)
        # Also by a view of a weight: all tensors that share their memory count together.
        if self._versions() != versions:
            raise RefusedError("it changes its own weights: export it in eval mode")
        found = tuple(values[name] for name in self.outputs)
        assert all(isinstance(one, Tensor) for one in found)
        return found

    def unread(self) -> list[str]:
        """The names of the inputs that nothing is computed from."""
        read = set(self.outputs)
        for step in self.steps:
            read |= _names([*step.args, *step.kwargs.values()])
        return [name for name in self.given if name not in read]

    def _versions(self) -> list[int]:
        """How often each weight was changed in place."""
        return [weight._version for weight in self._buffers.values() if weight is not None]


class Single(nn.Module):
    """A graph with one input, as a module that returns one of its outputs.

    Args:
        graph: the graph.
        output: number of the output.
    """

    def __init__(self, graph: Graph, output: int = 0) -> None:
        super().__init__()
        self.graph, self.output = graph, output

    def forward(self, given: Tensor) -> Tensor:
        found: Tensor = self.graph(given)[self.output]
        return found


def _tensor_name(output: Mapping[str, Any]) -> str:
    ((kind, value),) = output.items()
    if kind != "as_tensor":
        raise RefusedError(f"it returns something that is no tensor ({kind})")
    return str(value["name"])


def _run(steps: Sequence[Step], values: dict[str, Any], device: torch.device) -> None:
    for step in steps:
        args = [_given(argument, values, device) for argument in step.args]
        kwargs = {name: _given(argument, values, device) for name, argument in step.kwargs.items()}
        try:
            found = step.call(*args, **kwargs)
        except (RefusedError, OperationError):
            raise
        except Exception as error:
            raise OperationError(step.name) from error
        _keep(step.results, found, values)


def _given(argument: Any, values: Mapping[str, Any], device: torch.device) -> Any:
    if isinstance(argument, Value):
        return values[argument.name]
    if isinstance(argument, list):
        return [_given(one, values, device) for one in argument]
    return device if isinstance(argument, Device) else argument


def _names(arguments: Sequence[Any]) -> set[str]:
    """The names of the values among arguments."""
    found: set[str] = set()
    for one in arguments:
        found |= {one.name} if isinstance(one, Value) else _names(one) if isinstance(one, list) else set()
    return found


def _keep(names: Any, results: Any, values: dict[str, Any]) -> None:
    if isinstance(names, str):
        values[names] = results
    elif names is not None:
        for name, result in zip(names, results, strict=True):
            _keep(name, result, values)


def _steps(graph: Mapping[str, Any]) -> tuple[Step, ...]:
    return tuple(
        _no_grad(node) if node["target"] == NO_GRAD else _step(node)
        for node in graph["nodes"]
        if not ASSERTIONS.fullmatch(node["target"])
    )


def _step(node: Mapping[str, Any]) -> Step:
    args: list[Any] = []
    kwargs: dict[str, Any] = {}
    target = node["target"]
    found, call = (None, number) if (number := _number(target)) else operation(target)
    for given in node["inputs"]:
        value = _argument(given["arg"])
        # 2 is KEYWORD. A file of an older torch says nothing; then every name is one of the operation's schema.
        if given.get("kind") == 2 or (given.get("kind") is None and isinstance(found, OpOverload)):
            kwargs[str(given["name"])] = value
        else:
            args.append(value)
    return Step(target.removeprefix("torch.ops."), call, tuple(args), kwargs, _results(node["outputs"]))


def _no_grad(node: Mapping[str, Any]) -> Step:
    """A part of a program under `torch.no_grad()`."""
    enabled, graph, *given = (entry["arg"] for entry in node["inputs"])
    inner = graph["as_graph"]["graph"]
    names = [str(value["as_tensor"]["name"]) for value in inner["inputs"]]
    outputs = [_argument(value) for value in inner["outputs"]]
    steps, arguments = _steps(inner), [_argument(argument) for argument in given]
    single = bool(inner.get("is_single_tensor_return"))

    def call(device: torch.device, *args: Any) -> Any:
        values = dict(zip(names, args, strict=True))
        with nullcontext() if enabled["as_bool"] else torch.no_grad():
            _run(steps, values, device)
        found = [_given(output, values, device) for output in outputs]
        return found[0] if single else found

    results = _results(node["outputs"])
    alone = isinstance(results, str) and not single
    return Step("torch.no_grad", call, (Device(), *arguments), {}, [results] if alone else results)


def _number(target: str) -> Callable[..., Any] | None:
    """An operation on sizes; what it makes must fit into 64 bits, or a few of them fill the memory."""
    if target not in NUMBERS:
        return None
    compute = NUMBERS[target]

    def call(*numbers: Any) -> Any:
        if not all(isinstance(number, int | float) for number in numbers):
            raise RefusedError(f"{target} of something that is no number")
        found = compute(*numbers)
        if abs(found) >= 2**63:
            raise RefusedError(f"{target} makes a number that is too large")
        return found

    return call


def _results(outputs: Sequence[Mapping[str, Any]]) -> Any:
    """The names of the results of a node: one, or a list for several; None for a result without a name."""
    names = [_result(output) for output in outputs]
    return names[0] if len(names) == 1 else names


def _result(output: Mapping[str, Any]) -> Any:
    ((kind, value),) = output.items()
    match kind:
        case "as_tensor":
            return str(value["name"])
        case "as_tensors":
            return [str(one["name"]) for one in value]
        case "as_sym_int" | "as_sym_float" | "as_sym_bool":
            return str(value["as_name"])
        case "as_none":
            return None
        case _:
            raise RefusedError(f"an operation returns something that is no tensor ({kind})")


def _argument(argument: Mapping[str, Any]) -> Any:
    """The value of an argument of the format.

    Raises:
        RefusedError: if it is not a value of the graph, a number, a type or one of `WORDS`.
    """
    ((kind, value),) = argument.items()
    match kind:
        case "as_none":
            return None
        case "as_tensor":
            return Value(str(value["name"]))
        case "as_tensors" | "as_nested_tensors":
            return [_nested(one) for one in value]
        case "as_optional_tensor" | "as_sym_int" | "as_sym_float" | "as_sym_bool":
            return _symbol(value)
        case "as_optional_tensors" | "as_sym_ints" | "as_sym_floats" | "as_sym_bools":
            return [_symbol(one) for one in value]
        case (
            "as_int" | "as_float" | "as_bool" | "as_ints" | "as_floats" | "as_bools" | "as_int_lists" | "as_float_lists"
        ):
            return _plain(value)
        case "as_scalar_type" if value in DTYPES:
            return DTYPES[value]
        case "as_memory_format" if value in FORMATS:
            return FORMATS[value]
        case "as_layout" if value == STRIDED:
            return torch.strided
        case "as_device":
            return Device()
        case "as_string" if value in WORDS:
            return value
        case _:
            raise RefusedError(f"an operation has an argument that is not read ({kind} {str(value)[:40]!r})")


def _nested(one: Any) -> Any:
    return [_nested(inner) for inner in one] if isinstance(one, list) else Value(str(one["name"]))


def _symbol(value: Mapping[str, Any]) -> Any:
    """A size: by its name or as a number; or a tensor, or none."""
    ((kind, found),) = value.items()
    match kind:
        case "as_name":
            return Value(str(found))
        case "as_tensor":
            return Value(str(found["name"]))
        case "as_none":
            return None
        case "as_int" | "as_float" | "as_bool":
            return _plain(found)
        case _:
            raise RefusedError(f"an operation has an argument that is not read ({kind})")


def _plain(value: Any) -> Any:
    """A number, or lists of numbers. The format writes infinities as words."""
    if isinstance(value, list):
        return [_plain(one) for one in value]
    if value in ("Infinity", "-Infinity", "NaN"):
        return float(value)
    if not isinstance(value, bool | int | float):
        raise RefusedError("an operation has an argument that is no number")
    return value
