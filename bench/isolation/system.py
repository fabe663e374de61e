"""Settings of a process that the operating system keeps: its folder, limits, signals, user, and how its processor rounds."""

from __future__ import annotations

import ctypes
import math
import os
import signal
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from cavbench.isolation import tree
from cavbench.isolation.setting import Setting, same_objects

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

PR_GET_PDEATHSIG, PR_GET_CHILD_SUBREAPER = 2, 37
"""Parameters of Linux' prctl(2)."""
TIMERS = tuple(
    getattr(signal, name) for name in ("ITIMER_REAL", "ITIMER_VIRTUAL", "ITIMER_PROF") if hasattr(signal, name)
)
SIGNALS = tuple(signal.valid_signals())
OUTPUT = (0, 1, 2)
"""The descriptors of the standard streams."""


def _folder() -> str:
    try:
        return os.getcwd()
    except OSError:
        return ""


def _mask() -> int:
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("Umask:"):
                return int(line.split()[1], 8)
    mask = os.umask(0o077)
    os.umask(mask)
    return mask


def _handlers() -> dict[int, object]:
    return {number: signal.getsignal(number) for number in SIGNALS}


def _put_handlers(before: Mapping[int, Any]) -> None:
    for number, handler in before.items():
        if handler is not None and signal.getsignal(number) is not handler:
            with suppress(OSError, ValueError):
                signal.signal(number, handler)


def _timers() -> list[bool]:
    """Whether a timer runs that will send a signal, which ends a process that does not expect it."""
    return [signal.getitimer(timer)[0] > 0 for timer in TIMERS]


def _stop_timers(before: list[bool]) -> None:
    for timer, ran in zip(TIMERS, before, strict=True):
        if not ran:
            signal.setitimer(timer, 0)


def _blocking() -> dict[int, bool]:
    """Whether writing to a standard stream waits until all is written: otherwise a long table is cut off."""
    found = {}
    for number in OUTPUT:
        with suppress(OSError):
            found[number] = os.get_blocking(number)
    return found


def _put_blocking(before: Mapping[int, bool]) -> None:
    for number, on in before.items():
        os.set_blocking(number, on)


def _limits() -> dict[int, tuple[int, int]]:
    kinds = {number for name, number in vars(resource).items() if name.startswith("RLIMIT_")} if resource else set()
    return {kind: resource.getrlimit(kind) for kind in kinds}


def _put_limits(before: Mapping[int, tuple[int, int]]) -> None:
    for kind, limit in before.items():
        with suppress(OSError, ValueError):
            resource.setrlimit(kind, limit)


def _prctl(what: int) -> Callable[[], int]:
    """Reads a number of the process that the kernel writes to an address."""

    def read() -> int:
        if sys.platform != "linux":
            return 0
        value = ctypes.c_int()
        ctypes.CDLL(None).prctl(what, ctypes.byref(value), 0, 0, 0)
        return value.value

    return read


def _adopt(on: int) -> None:
    ctypes.CDLL(None).prctl(tree.PR_SET_CHILD_SUBREAPER, on, 0, 0, 0)


def _arithmetic() -> tuple[float, float, bool, bool]:
    """What shows how the processor rounds, and whether it flushes denormal numbers: libraries set both for a whole thread."""
    three, smallest = float(len(OUTPUT)), sys.float_info.min
    return 1.0 / three, 2.0 / three, smallest / three == 0.0, math.ulp(0.0) == 0.0


def _put_arithmetic(_: object) -> None:
    # FE_TONEAREST is 0 on x86 and Arm.
    ctypes.CDLL(None).fesetround(0)
    if "torch" in sys.modules:
        sys.modules["torch"].set_flush_denormal(False)


SYSTEM = (
    Setting(name="the current folder", read=_folder, write=os.chdir),
    Setting(name="the umask", read=_mask, write=os.umask),
    Setting(name="signal handlers", read=_handlers, write=_put_handlers, kept=same_objects),
    Setting(name="timers of the process", read=_timers, write=_stop_timers),
    Setting(
        name="the blocked signals",
        read=lambda: signal.pthread_sigmask(signal.SIG_BLOCK, ()),
        write=lambda value: signal.pthread_sigmask(signal.SIG_SETMASK, value),
    ),
    Setting(name="limits of the process", read=_limits, write=_put_limits),
    Setting(
        name="the cores of the process",
        read=lambda: os.sched_getaffinity(0),
        write=lambda value: os.sched_setaffinity(0, value),
    ),
    Setting(name="the priority of the process", read=lambda: os.getpriority(os.PRIO_PROCESS, 0)),
    Setting(name="how the process is scheduled", read=lambda: os.sched_getscheduler(0)),
    Setting(name="the user of the process", read=lambda: (os.getresuid(), os.getresgid(), sorted(os.getgroups()))),
    Setting(name="the group of the process", read=os.getpgrp, write=lambda value: os.setpgid(0, value)),
    Setting(name="whether the process adopts others", read=_prctl(PR_GET_CHILD_SUBREAPER), write=_adopt),
    Setting(name="what ends the process with its parent", read=_prctl(PR_GET_PDEATHSIG)),
    Setting(
        name="whether standard input or output waits",
        read=_blocking,
        write=_put_blocking,
        # One that was closed is noticed elsewhere.
        kept=lambda before, after: all(after.get(number, on) == on for number, on in before.items()),
    ),
    Setting(name="how the processor rounds", read=_arithmetic, write=_put_arithmetic),
)
"""Compared before and after the import of a plug-in, as `cavbench.isolation.settings.SETTINGS`."""
