"""Sets up a process of the benchmark: one thread, and freed memory is kept."""

from __future__ import annotations

import contextlib
import ctypes
import os

M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD = -1, -2, -3
"""Parameters of glibc's mallopt(3)."""


def settle() -> None:
    """Prepare this process for many small forward passes.

    Torch gets one thread: work is distributed over processes, and threads slow down networks this small. The C library keeps
    freed memory: otherwise it returns every intermediate tensor to the kernel and faults it in again, which halves the speed
    of a forward pass on a thousand observations.
    """
    import torch

    torch.set_num_threads(1)
    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")
    with contextlib.suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL("libc.so.6").mallopt
        for parameter, size in ((M_MMAP_THRESHOLD, 1 << 30), (M_TRIM_THRESHOLD, (1 << 31) - 1), (M_TOP_PAD, 1 << 26)):
            mallopt(parameter, size)
