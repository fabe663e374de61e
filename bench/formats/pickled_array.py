"""The numbers of a numpy array in a pickle, read without unpickling it."""

from __future__ import annotations

import base64
import binascii
import pickletools

import numpy as np
from numpy.typing import NDArray

TYPES = {"f4": "<f4", "f8": "<f8", "u1": "u1"}
"""Types of numbers that are read, by their names in the pickle."""


def floats(pickled: str, size: int) -> NDArray[np.float32] | None:
    """The numbers of the only array in a pickle, which are float32, float64 or uint8: [n, size].

    A pickle is a program, whose operations are listed here and not carried out. The numbers are the only block of bytes in it
    that holds whole rows of `size` numbers.

    Args:
        pickled: the pickle, in base64.
        size: numbers in a row of the array, at least 1.

    Returns:
        None if the pickle cannot be read, or has no such block or several.
    """
    try:
        content = base64.b64decode(pickled, validate=True)
        given = [argument for _, argument, _ in pickletools.genops(content)]
    except (ValueError, binascii.Error, IndexError, EOFError, KeyError, UnicodeDecodeError, RecursionError):
        return None
    types = {TYPES[one] for one in given if isinstance(one, str) and one in TYPES}
    if len(types) != 1:
        return None
    kind = np.dtype(types.pop())
    blocks = [one for one in given if isinstance(one, bytes | bytearray)]
    rows = [block for block in blocks if block and len(block) % (kind.itemsize * size) == 0]
    return np.frombuffer(bytes(rows[0]), kind).astype(np.float32).reshape(-1, size) if len(rows) == 1 else None
