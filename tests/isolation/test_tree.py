"""What a process and its descendants use is counted, also if they hide it."""

from __future__ import annotations

import ctypes
import os
import sys
import time

import pytest

from cavbench.isolation import tree

PR_SET_DUMPABLE = 4
"""Parameter of Linux' prctl(2): with 0, only root may read what a process has mapped."""
HIDDEN = 100_000_000


def _measure(write: int) -> None:
    """As nobody, start a process that hides what it has, and write what is counted."""
    # Root reads everything.
    if not os.getuid():
        os.setgid(65534)
        os.setuid(65534)
    ready, tell = os.pipe()
    if not (child := os.fork()):
        taken = bytearray(HIDDEN)
        taken[::4096] = b"1" * len(taken[::4096])
        ctypes.CDLL(None).prctl(PR_SET_DUMPABLE, 0, 0, 0, 0)
        os.write(tell, b".")
        time.sleep(60)
        os._exit(0)
    os.read(ready, 1)
    os.write(write, f"{tree._shares(child)} {tree.used_bytes(os.getpid())}".encode())
    os.kill(child, 9)


@pytest.mark.skipif(sys.platform != "linux", reason="processes are counted on Linux only")
def test_a_process_that_hides_its_memory_is_counted() -> None:
    read, write = os.pipe()
    if not (parent := os.fork()):
        try:
            _measure(write)
        finally:
            os._exit(0)
    shares, used = os.read(read, 4096).decode().split()
    os.waitpid(parent, 0)
    os.close(read)
    os.close(write)
    assert shares == "{}"
    assert int(used) > HIDDEN
