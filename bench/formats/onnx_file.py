"""Reads an ONNX file as one string of bytes that holds all its tensors, so that nothing beside it is read when it runs.

A tensor of an ONNX model may lie in another file, at any place of the disk that the model names. The model is parsed with the
schema of the onnx package, whatever it takes from other files is put into it, and it is written again. Those bytes are hashed,
and those bytes are run: it does not matter whether another parser would have read the file otherwise.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cavbench import bounded
from cavbench.archive import LARGEST
from cavbench.errors import UserError, short

LONGEST_NAME = 255
"""Bytes of the longest name that a file can have."""
KEYS = frozenset(["location", "offset", "length", "checksum"])
"""What a model may say of a tensor in another file. The checksum is not needed: the tensor's bytes are part of the hash."""
BITS = {"INT4": 4, "UINT4": 4, "FLOAT4E2M1": 4, "INT2": 2, "UINT2": 2}
"""Bits of an element, for the types that lie packed in memory."""
CONTENTS = (
    *("raw_data", "float_data", "int32_data", "int64_data", "double_data", "uint64_data", "string_data"),
    "segment",
)
"""Where a tensor keeps its numbers in the model itself."""


def whole(path: Path, name: str) -> bytes:
    """The model with all its tensors in it.

    Notes for other programs (`metadata_props`, which ONNX Runtime can take settings from) and training graphs, which it does not
    run, are left out.

    Args:
        path: the model.
        name: its name in errors.

    Raises:
        ImportError: if the onnx package is missing.
        UserError: if the file is not a model, has fields that the onnx package does not know, names a file in another folder, or
            has more than 1 GiB together with its files.
    """
    import onnx

    content = bounded.content(path, most=LARGEST, name=name)
    try:
        model = onnx.ModelProto.FromString(content)
    # The class of this exception is in the package of protocol buffers, which onnx brings.
    except Exception as error:
        raise UserError(f"{name} cannot be read: it is not an ONNX model, or a damaged one") from error
    size = model.ByteSize()
    model.DiscardUnknownFields()
    if model.ByteSize() != size:
        raise UserError(
            f"{name} is refused: it has fields or values that onnx {onnx.__version__} does not know; what they mean is not known"
        )
    model.ClearField("training_info")
    left = LARGEST - size
    for message in list(_messages(model)):
        if "metadata_props" in message.DESCRIPTOR.fields_by_name:
            message.ClearField("metadata_props")
        if isinstance(message, onnx.TensorProto):
            if message.data_location == onnx.TensorProto.EXTERNAL:
                message.raw_data = _beside(message, path, name, left)
                left -= len(message.raw_data)
            message.ClearField("external_data")
            message.ClearField("data_location")
    written: bytes = model.SerializeToString(deterministic=True)
    return written


def _messages(message: Any) -> Iterator[Any]:
    """A message and all messages in it, at any depth: bodies of loops, functions, attributes, sparse tensors."""
    yield message
    for field, value in message.ListFields():
        if field.message_type is not None:
            for one in (value,) if hasattr(value, "ListFields") else value:
                yield from _messages(one)


def _beside(tensor: Any, path: Path, name: str, most: int) -> bytes:
    """The bytes of a tensor that lies in another file, of at most so many bytes."""
    # What is no text in UTF-8 is given as bytes.
    said = {str(entry.key): str(entry.value) for entry in tensor.external_data}
    place = said.get("location", "")
    what = f"{name} is refused: its tensor {short(str(tensor.name))!r}"
    if len(said) < len(tensor.external_data) or not said.keys() <= KEYS:
        raise UserError(f"{what} says where it lies twice, or in words that are not known: {short(', '.join(said))!r}")
    if any(tensor.HasField(one) if one in ("raw_data", "segment") else getattr(tensor, one) for one in CONTENTS):
        raise UserError(f"{what} lies in the model and in {short(place)!r}; it may lie in one of them only")
    if not place.isprintable() or len(os.fsencode(place)) > LONGEST_NAME:
        raise UserError(f"{name} is refused: it reads {short(place)!r}, which is no name of a file")
    file = path.parent / place
    if not place or "/" in place or "\\" in place or "\0" in place or place == ".." or file.is_symlink():
        raise UserError(f"{name} is refused: it reads {place!r}; a model may read files in its own folder only")
    if not file.is_file():
        raise UserError(f"{name} cannot be read: it needs the file {place!r} beside it")
    size = _size(tensor)
    offset, length = _whole(said.get("offset", "0")), _whole(said.get("length", str(size)))
    if size is None or offset is None or length != size:
        raise UserError(f"{what} has other sizes in {short(place)!r} than in the model; export it again")
    if size > most:
        raise UserError(f"{name} is refused: it has more than {LARGEST >> 30} GiB with the files beside it")
    with bounded.opened(file, most=LARGEST, links=False) as opened:
        opened.seek(offset)
        content = opened.read(size)
    if len(content) != size:
        raise UserError(f"{name} cannot be read: {file} ends before the tensor {short(tensor.name)!r} does")
    return content


def _size(tensor: Any) -> int | None:
    """Bytes of a tensor of numbers; None if its type or shape is none."""
    from onnx import TensorProto, helper

    count = 1
    for side in tensor.dims:
        count *= side
    if count < 0 or tensor.data_type in (TensorProto.UNDEFINED, TensorProto.STRING):
        return None
    try:
        word = TensorProto.DataType.Name(tensor.data_type)
        bits = BITS.get(word) or 8 * helper.tensor_dtype_to_np_dtype(tensor.data_type).itemsize
    except (ValueError, KeyError):
        return None
    return -(-count * bits // 8)


def _whole(text: str) -> int | None:
    """A whole number of at least 0 in decimal digits; None for anything else."""
    return int(text) if text.isascii() and text.isdigit() and len(text) < 20 else None
