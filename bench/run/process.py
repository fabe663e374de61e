"""Sets up a process of the benchmark: one thread, freed memory is kept, and it ends with its parent."""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import signal
import sys
import threading
from multiprocessing.context import BaseContext
from pathlib import Path

from cavbench.isolation import tree

M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD = -1, -2, -3
"""Parameters of glibc's mallopt(3)."""
PR_SET_PDEATHSIG = 1
"""Parameter of Linux' prctl(2)."""


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


def follow_parent() -> None:
    """End this child process, made by `multiprocessing`, when its parent ends, however that ends; and ignore Ctrl-C.

    On Linux the kernel kills it, even in the middle of a computation. The kernel watches the thread that started this process:
    start it from a thread that lives as long as its parent. Elsewhere, and for a process of a fork server, a thread watches, too.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None
    _die_with_parent()
    if not parent.is_alive():
        os._exit(1)
    # What a component forks ends with this process in the same way.
    os.register_at_fork(after_in_child=_die_with_parent)

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def _die_with_parent() -> None:
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)


def children() -> frozenset[int]:
    """The processes that this one started and that are there; empty where that cannot be read."""
    found: set[int] = set()
    for listed in Path("/proc/self/task").glob("*/children"):
        with contextlib.suppress(OSError):
            found.update(int(number) for number in listed.read_text().split())
    return frozenset(found)


def context(*modules: str) -> BaseContext:
    """How new processes are made: forked from a server that has imported `modules`, and so at once; or else from nothing.

    The server has one thread and ends with this process.
    """
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    from multiprocessing import forkserver

    made = multiprocessing.get_context("forkserver")
    made.set_forkserver_preload(list(modules))
    # By itself the server imports from the current folder first, where a user's file may be called `bench.py`.
    before = dict(os.environ)
    os.environ |= {"PYTHONSAFEPATH": "1", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    try:
        with tree.ours():
            forkserver.ensure_running()
    finally:
        os.environ.clear()
        os.environ.update(before)
    return made


def machine_bytes() -> int:
    """The physical memory that this machine, or the container, has in bytes; 0 if that cannot be read."""
    limits = []
    with contextlib.suppress(OSError, ValueError):
        limits.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    for name in ("memory.max", "memory/memory.limit_in_bytes"):
        with contextlib.suppress(OSError, ValueError):
            limits.append(int(Path("/sys/fs/cgroup", name).read_text()))
    return min(limits, default=0)


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
