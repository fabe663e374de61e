"""Reads a program written by `torch.export.save`, without `torch.export.load`, which runs code from the file.

That function unpickles weights, constants, sample inputs and objects, loads compiled libraries, evaluates the expressions of
shapes (`sympy.sympify`), calls any function of torch by its name, and makes Python source code of the names of values. Here
the archive is unpacked within bounds, tensors are raw bytes, and a program is a list of ATen operations on numbers and tensors.

Format: `torch/_export/serde/schema.py` of torch 2.13, schema version 8.
"""

from __future__ import annotations

import io
import json
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.serialization import get_unsafe_globals_in_checkpoint

from cavbench.archive import Archive
from cavbench.errors import UserError, short
from cavbench.formats.torch_graph import DTYPES, Graph
from cavbench.formats.trial import RefusedError

SCHEMA = 8
"""Major version of the format that is read."""
MEMBERS = re.compile(
    r"archive_format|archive_version|byteorder|version|\.data/(version|serialization_id)|models/model\.json|extra/.*"
    r"|data/weights/(weight_\d+|model_weights_config\.json)|data/constants/(tensor_\d+|model_constants_config\.json)"
    r"|data/sample_inputs/model\.pt"
)
"""The members that `torch.export.save` writes for a program of tensors."""
SAMPLES = "data/sample_inputs/model.pt"
INERT = {"torch._export.serde.serialize._reconstruct_fake_tensor"}
"""A name in the sample inputs of honest programs. Nothing in that pickle is ever loaded."""


@dataclass(frozen=True)
class Value:
    """A tensor that a program takes or returns.

    Args:
        name: its name in the program; of an input that of the argument.
        shape: its shape; None for an axis of any size.
        dtype: its type; None for a type that is not read.
    """

    name: str
    shape: tuple[int | None, ...]
    dtype: torch.dtype | None

    def __str__(self) -> str:
        sides = ", ".join("any" if side is None else str(side) for side in self.shape)
        return f"{str(self.dtype or 'an unknown type').removeprefix('torch.')} [{sides}]"


@dataclass(frozen=True)
class Program:
    """A program.

    Args:
        graph: the program as a module.
        inputs: what it takes, in order.
        outputs: what it returns, in order.
    """

    graph: Graph
    inputs: tuple[Value, ...]
    outputs: tuple[Value, ...]

    @property
    def shape(self) -> tuple[int | None, ...]:
        """The shape of its first input."""
        return self.inputs[0].shape

    @property
    def dtype(self) -> torch.dtype | None:
        """The type of its first input."""
        return self.inputs[0].dtype


def read(path: Path, name: str, *, several: bool = False) -> Program:
    """Read a program.

    Args:
        path: the file.
        name: its name in errors.
        several: whether it may have several inputs.

    Raises:
        UserError: if the file is not such a program, or holds anything else than tensors and operations on tensors.
    """
    members = _members(Archive.read(path, name), name)
    try:
        _check_samples(members, name)
        program = _program(members, name)
        if not program.inputs or (len(program.inputs) > 1 and not several):
            raise UserError(f"{name} takes {len(program.inputs)} inputs, it must take one tensor")
        return program
    except RefusedError as error:
        raise UserError(f"{name} is refused: {error}") from error
    # Any part of the JSON may be missing or of another type.
    except (KeyError, ValueError, TypeError, AttributeError, IndexError, RuntimeError, RecursionError) as error:
        raise UserError(f"{name} cannot be read: it is not a program of torch.export.save, or a damaged one") from error


def _members(archive: Archive, name: str) -> dict[str, bytes]:
    """The members by their names below the root folder; all of them must be known."""
    roots = {member.partition("/")[0] for member in archive.members}
    found = {member.partition("/")[2]: content for member, content in archive.members.items()}
    if len(roots) > 1 or found.get("archive_format") != b"pt2":
        raise UserError(f"{name} cannot be read: it is not written by torch.export.save of torch 2.8 or later")
    for member in found:
        if not MEMBERS.fullmatch(member):
            raise UserError(f"{name} is refused: it holds {short(member)!r}; {_why(member)}")
    if found.get("byteorder", b"little") != sys.byteorder.encode():
        raise UserError(f"{name} cannot be read: it was written on a machine with another byte order")
    return found


def _why(member: str) -> str:
    if member.startswith("data/aotinductor"):
        return "compiled code is not run: save the program with torch.export.save"
    if re.search(r"(opaque_obj|custom_obj)_\d+$|\.pt$", member):
        return "pickled objects are not loaded: export a network whose state is tensors"
    return "a program of torch.export.save has no such member"


def _check_samples(members: Mapping[str, bytes], name: str) -> None:
    """Refuse sample inputs that name code. They are never loaded; a file with code in it is not an honest one."""
    if not members.get(SAMPLES):
        return
    copy = Archive(members[SAMPLES], f"{name}, {SAMPLES}").repacked()
    named = sorted(set(get_unsafe_globals_in_checkpoint(io.BytesIO(copy.getvalue()))) - INERT)
    if named:
        raise RefusedError(f"its sample inputs name {named[0]}, which is code: export it with tensors as sample inputs")


def _program(members: Mapping[str, bytes], name: str) -> Program:
    program = json.loads(members["models/model.json"])
    major = program["schema_version"]["major"]
    if major != SCHEMA:
        raise RefusedError(
            f"its format has version {major}, not {SCHEMA}: export it again with torch {torch.__version__}"
        )
    weights = _tensors(members, "weights", "weight_") | _tensors(members, "constants", "tensor_")
    module = program["graph_module"]
    inputs, user = {}, []
    for spec, value in zip(module["signature"]["input_specs"], module["graph"]["inputs"], strict=True):
        ((kind, given),) = spec.items()
        match kind:
            case "parameter" | "buffer" | "tensor_constant":
                inputs[value["as_tensor"]["name"]] = weights[given[f"{kind}_name"]]
            case "user_input" if "as_tensor" in value:
                user.append(value["as_tensor"]["name"])
            case "constant_input":
                pass
            case _:
                raise RefusedError(f"it has an input that is no tensor ({kind})")
    outputs = [next(iter(spec)) for spec in module["signature"]["output_specs"]]
    if mutations := sorted({kind for kind in outputs if kind != "user_output"}):
        raise RefusedError(f"it changes its own state ({', '.join(mutations)}): export it in eval mode")
    values = module["graph"]["tensor_values"]
    graph = Graph(module["graph"], user, inputs)
    taken, returned = (tuple(_value(one, values[one]) for one in names) for names in (user, graph.outputs))
    return Program(graph, taken, returned)


def _value(name: str, meta: Mapping[str, Any]) -> Value:
    shape = tuple(int(side["as_int"]) if "as_int" in side else None for side in meta["sizes"])
    return Value(name, shape, DTYPES.get(meta["dtype"]))


def _tensors(members: Mapping[str, bytes], folder: str, prefix: str) -> dict[str, Tensor]:
    """The tensors of a folder by their names; tensors in the same file share their memory."""
    listed = members.get(f"data/{folder}/model_{folder}_config.json")
    config = json.loads(listed)["config"] if listed else {}
    flat: dict[str, Tensor] = {}
    return {name: _tensor(name, entry, members, f"data/{folder}/", prefix, flat) for name, entry in config.items()}


def _tensor(
    name: str, entry: Mapping[str, Any], members: Mapping[str, bytes], folder: str, prefix: str, flat: dict[str, Tensor]
) -> Tensor:
    path, meta = entry["path_name"], entry["tensor_meta"]
    if entry["use_pickle"] or not path.startswith(prefix):
        raise RefusedError(f"{name!r} is pickled: only plain tensors are loaded")
    if meta["dtype"] not in DTYPES:
        raise RefusedError(f"{name!r} has a type that is not read (number {meta['dtype']})")
    dtype = DTYPES[meta["dtype"]]
    if path not in flat:
        content = members[folder + path]
        # The copy lies in memory as torch's own tensors do; otherwise a product can differ in its last bit.
        flat[path] = (
            torch.frombuffer(bytearray(content), dtype=dtype).clone() if content else torch.empty(0, dtype=dtype)
        )
    if flat[path].dtype != dtype:
        raise RefusedError(f"{name!r} shares its bytes with a tensor of another type")
    sizes, strides = (list(_whole(meta[key])) for key in ("sizes", "strides"))
    (offset,) = _whole([meta["storage_offset"]])
    return flat[path].as_strided(sizes, strides, offset)


def _whole(sides: list[Mapping[str, Any]]) -> Iterator[int]:
    """Whole numbers of at least 0: sizes, strides, an offset."""
    for side in sides:
        number = side["as_int"]
        if type(number) is not int or not 0 <= number < 2**40:
            raise RefusedError("a size is not a whole number of at least 0")
        yield number
