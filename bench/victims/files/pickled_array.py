"""The numbers of a numpy array in a pickle, read without unpickling it."""

from __future__ import annotations

import base64
import binascii
import pickletools

import numpy as np
from numpy.typing import NDArray


def floats(pickled: str, size: int) -> NDArray[np.float32] | None:
    """The float32 numbers of the only array in a pickle: [n, size].

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
        blocks = [argument for _, argument, _ in pickletools.genops(content) if isinstance(argument, bytes | bytearray)]
    except (ValueError, binascii.Error, IndexError, EOFError, KeyError, UnicodeDecodeError, RecursionError):
        return None
    rows = [block for block in blocks if block and len(block) % (4 * size) == 0]
    return np.frombuffer(bytes(rows[0]), "<f4").reshape(-1, size) if len(rows) == 1 else None
