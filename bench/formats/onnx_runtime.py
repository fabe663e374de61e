"""A network in an ONNX file, evaluated with ONNX Runtime. It has no gradients."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType as Fixed
from typing import Any

import torch
from torch import Tensor

from cavbench.errors import UserError, short
from cavbench.formats.onnx_file import whole
from cavbench.formats.trial import OperationError

LIBRARY = "onnxruntime"
TYPES = {"tensor(float)": torch.float32, "tensor(float16)": torch.float16}
"""The allowed types of the input."""
BYTES = {"tensor(uint8)": torch.uint8}
"""Those of a network that takes images, besides."""


@dataclass(frozen=True)
class Model:
    """A model with one input, and perhaps others that say something about it.

    Args:
        session: of ONNX Runtime.
        given: name of its input.
        shape: shape of its input; None for an axis of any size.
        dtype: type of its input.
        outputs: names of its outputs.
        sha256: hash of the file, and of the bytes that are run (`cavbench.formats.onnx_file.whole`).
        others: names of its other inputs.
    """

    session: Any
    given: str
    shape: tuple[int | None, ...]
    dtype: torch.dtype
    outputs: tuple[str, ...]
    sha256: str
    others: tuple[str, ...] = ()

    @property
    def whole(self) -> tuple[bool, ...]:
        """Whether each output is of whole numbers."""
        return tuple("int" in one.type for one in self.session.get_outputs())

    def run(self, given: Tensor, outputs: Sequence[str], **others: Tensor) -> tuple[Tensor, ...]:
        """Some of its outputs for an input, on the device of the input, as float32.

        Args:
            given: the input.
            outputs: the names of the outputs.
            others: the other inputs, by their names.

        Raises:
            OperationError: if it fails.
        """
        arrays = {name: tensor.numpy() for name, tensor in others.items()}
        arrays[self.given] = given.detach().cpu().to(self.dtype).contiguous().numpy()
        try:
            answers = self.session.run(list(outputs), arrays)
        # ONNX Runtime has many exceptions; their text names the operation.
        except Exception as error:
            node = re.search(r"running (\w+) node", str(error))
            raise OperationError(node[1]) if node else error from error
        return tuple(torch.from_numpy(answer).float().to(given.device) for answer in answers)


def read(
    path: Path, name: str, sha256: str, types: Mapping[str, torch.dtype] = TYPES, others: Mapping[str, str] = Fixed({})
) -> Model:
    """Read a model.

    Args:
        path: the file.
        name: its name in errors.
        sha256: hash of the file.
        types: allowed types of the input.
        others: types of other inputs that it may have, by their names.

    Raises:
        UserError: if ONNX Runtime or the onnx package is missing, the file is refused, or has other inputs or outputs than
            tensors.
    """
    try:
        import onnxruntime

        content = whole(path, name)
    except ImportError:
        raise UserError(f"{name} needs ONNX Runtime: pip install 'cavbench[onnx]'") from None
    sha256 = hashlib.sha256((sha256 + hashlib.sha256(content).hexdigest()).encode()).hexdigest()
    onnxruntime.disable_telemetry_events()
    # Its own complaints would go to standard error beside ours.
    onnxruntime.set_default_logger_severity(4)
    options = onnxruntime.SessionOptions()
    options.add_session_config_entry("session.load_model_format", "ONNX")
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    try:
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        if unknown := re.search(r"([\w.]+:\w+)\(-?\d+\) is not a registered", str(error)):
            raise UserError(
                f"{name} is refused: it needs the operation {short(unknown[1])}, which ONNX Runtime does not have"
            ) from error
        raise
    inputs, outputs = session.get_inputs(), session.get_outputs()
    main = [one for one in inputs if others.get(one.name) != one.type]
    if len(main) != 1 or main[0].type not in types:
        raise UserError(f"{name} takes {_listed(inputs)}; it must take one tensor(float)")
    if any(not one.type.startswith("tensor(") for one in outputs):
        raise UserError(f"{name} returns {_listed(outputs)}; it must return tensors")
    shape = tuple(side if isinstance(side, int) else None for side in main[0].shape)
    names, also = tuple(one.name for one in outputs), tuple(one.name for one in inputs if one is not main[0])
    return Model(session, main[0].name, shape, types[main[0].type], names, sha256, also)


def _listed(values: Sequence[Any]) -> str:
    return ", ".join(f"{one.name} {one.type}" for one in values) or "nothing"
