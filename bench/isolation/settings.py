"""Settings of a process that all its components share: notices what foreign code changed, and puts it back."""

from __future__ import annotations

import builtins
import gc
import locale
import operator
import os
import signal
import socket
import stat
import sys
import threading
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cavbench.isolation.framework import LIBRARIES, OWN

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

OURS = (
    *("PYTHON", "LD_PRELOAD", "LD_AUDIT", "DYLD_INSERT", "LC_", "LANG", "TZ", "HOME", "PATH", "TMP", "TEMP", "XDG_"),
    *("CAVBENCH_", "BENCH_"),
)
"""Beginnings of the names of environment variables that foreign code may neither add nor change."""
THEIRS = ("OMP_", "MKL_", "OPENBLAS_", "NUMBA_", "TORCH", "CUDA_")
"""The same for those that it may add: libraries do when they are imported. All others may change, and none may go."""
UNKNOWN = object()
RECURSION = "the recursion limit"
NUMPY = {"divide": "warn", "over": "warn", "under": "ignore", "invalid": "warn"}


@dataclass(frozen=True, kw_only=True)
class Setting:
    """A setting of the process.

    Args:
        name: what it is called in errors.
        read: returns its value, which later changes do not reach.
        write: sets it; None for what cannot be put back.
        kept: whether a later value does others no harm, from the value before and the later one.
        module: a module that must be imported before it can be read; empty for none.
        usual: its value while that module is not imported.
    """

    name: str
    read: Callable[[], Any]
    write: Callable[[Any], object] | None = None
    kept: Callable[[Any, Any], bool] = operator.eq
    module: str = ""
    usual: Any = UNKNOWN

    def now(self) -> Any:
        """Its value; `UNKNOWN` if it cannot be read."""
        if self.module and self.module not in sys.modules:
            return self.usual
        try:
            return self.read()
        # A plug-in may have broken what reads it.
        except Exception:
            return UNKNOWN


class Settings:
    """The settings of this process as they are now.

    Args:
        alone: whether no other thread of ours runs, as in a copy of the process: then open files and threads are compared, too.
    """

    def __init__(self, *, alone: bool = False) -> None:
        self._before = [(setting, setting.now()) for setting in (SETTINGS + ALONE if alone else SETTINGS)]

    def changed(self) -> str:
        """The names of at most three settings that are other now; empty for none."""
        names = [setting.name for setting, before in self._before if not _is_kept(setting, before)]
        more = f" and {len(names) - 3} more" if len(names) > 3 else ""
        return ", ".join(names[:3]) + more

    def restore(self) -> None:
        """Put back what was changed and can be put back."""
        for setting, before in self._before:
            if setting.write and before is not UNKNOWN and not _is_kept(setting, before):
                with suppress(Exception):
                    setting.write(before)


def _is_kept(setting: Setting, before: Any) -> bool:
    return before is UNKNOWN or bool(setting.kept(before, setting.now()))


def _in_order(before: Sequence[object], after: Sequence[object]) -> bool:
    """Whether all that was in a list is there, in the same order."""
    rest = iter(after)
    return all(any(one is other or one == other for other in rest) for one in before)


def _same_objects(before: Mapping[Any, object], after: Mapping[Any, object]) -> bool:
    """Whether all that was there is there, unchanged."""
    return all(after.get(key) is value for key, value in before.items())


def _same_values(before: Mapping[Any, object], after: Mapping[Any, object]) -> bool:
    return all(after.get(key) == value for key, value in before.items())


def _environment(before: Mapping[str, str], after: Mapping[str, str]) -> bool:
    """Whether no variable is gone, and those that the benchmark depends on are as they were."""
    own = [name for name in after if name.startswith(OURS)] + [name for name in before if name.startswith(THEIRS)]
    return before.keys() <= after.keys() and all(before.get(name) == after[name] for name in own)


def _put_environment(before: Mapping[str, str]) -> None:
    os.environ.clear()
    os.environ.update(before)


def _filters(before: Sequence[object], after: Sequence[Any]) -> bool:
    """Whether filters of warnings were added only, and none that makes an error of a warning."""
    return all(one in after for one in before) and not any(one[0] == "error" for one in after if one not in before)


def _put_filters(before: list[Any]) -> None:
    assert isinstance(warnings.filters, list)
    warnings.filters[:] = before


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
    return {number: signal.getsignal(number) for number in signal.valid_signals()}


def _put_handlers(before: Mapping[int, Any]) -> None:
    for number, handler in before.items():
        if handler is not None and signal.getsignal(number) is not handler:
            with suppress(OSError, ValueError):
                signal.signal(number, handler)


def _limits() -> dict[int, tuple[int, int]]:
    kinds = {number for name, number in vars(resource).items() if name.startswith("RLIMIT_")} if resource else set()
    return {kind: resource.getrlimit(kind) for kind in kinds}


def _put_limits(before: Mapping[int, tuple[int, int]]) -> None:
    for kind, limit in before.items():
        with suppress(OSError, ValueError):
            resource.setrlimit(kind, limit)


def _modules() -> dict[str, object]:
    """The modules of the framework, and those that scores are computed with."""
    return {name: module for name, module in sys.modules.items() if name.partition(".")[0] == OWN or name in LIBRARIES}


def _files() -> dict[int, tuple[int, int]]:
    """The standard streams, pipes and sockets: files may be closed by the garbage collector at any time."""
    found = {}
    for number in [int(name) for name in os.listdir("/proc/self/fd")]:
        with suppress(OSError):
            about = os.fstat(number)
            if number < 3 or stat.S_ISFIFO(about.st_mode) or stat.S_ISSOCK(about.st_mode):
                found[number] = about.st_dev, about.st_ino
    return found


def _threads() -> frozenset[str]:
    """The threads that hold the end of the process."""
    return frozenset(one.name for one in threading.enumerate() if not one.daemon and one is not threading.main_thread())


def _torch() -> Any:
    return sys.modules["torch"]


def _modes() -> tuple[int, int]:
    """How many modes change what torch's functions do: a default device is one."""
    from torch.overrides import _get_current_function_mode_stack
    from torch.utils._python_dispatch import _get_current_dispatch_mode_stack

    return len(_get_current_function_mode_stack()), len(_get_current_dispatch_mode_stack())


SETTINGS = (
    Setting(name=RECURSION, read=sys.getrecursionlimit, write=sys.setrecursionlimit),
    Setting(name="the switch interval of threads", read=sys.getswitchinterval, write=sys.setswitchinterval),
    Setting(name="the trace function", read=sys.gettrace, write=sys.settrace, kept=operator.is_),
    Setting(name="the profile function", read=sys.getprofile, write=sys.setprofile, kept=operator.is_),
    Setting(
        name="the most digits of a number",
        read=lambda: sys.get_int_max_str_digits(),
        write=lambda value: sys.set_int_max_str_digits(value),
    ),
    Setting(name="the garbage collector", read=gc.isenabled, write=lambda on: gc.enable() if on else gc.disable()),
    Setting(name="the current folder", read=_folder, write=os.chdir),
    Setting(name="the umask", read=_mask, write=os.umask),
    Setting(name="environment variables", read=lambda: dict(os.environ), write=_put_environment, kept=_environment),
    Setting(
        name="the locale",
        read=lambda: locale.setlocale(locale.LC_ALL),
        write=lambda value: locale.setlocale(locale.LC_ALL, value),
    ),
    Setting(name="signal handlers", read=_handlers, write=_put_handlers, kept=_same_objects),
    Setting(name="limits of the process", read=_limits, write=_put_limits),
    Setting(
        name="the cores of the process",
        read=lambda: os.sched_getaffinity(0),
        write=lambda value: os.sched_setaffinity(0, value),
    ),
    Setting(name="the priority of the process", read=lambda: os.getpriority(os.PRIO_PROCESS, 0)),
    Setting(
        name="the import path",
        read=lambda: list(sys.path),
        write=lambda value: sys.path.__setitem__(slice(None), value),
        kept=_in_order,
    ),
    Setting(
        name="how Python imports",
        read=lambda: list(sys.meta_path),
        write=lambda value: sys.meta_path.__setitem__(slice(None), value),
        kept=_in_order,
    ),
    Setting(
        name="how Python finds modules",
        read=lambda: list(sys.path_hooks),
        write=lambda value: sys.path_hooks.__setitem__(slice(None), value),
        kept=_in_order,
    ),
    Setting(name="modules of the framework", read=_modules, write=sys.modules.update, kept=_same_objects),
    Setting(
        name="functions of Python",
        read=lambda: {name: value for name, value in vars(builtins).items() if name != "_"},
        write=vars(builtins).update,
        kept=_same_objects,
    ),
    Setting(
        name="standard input or output",
        read=lambda: {name: getattr(sys, name) for name in ("stdin", "stdout", "stderr")},
        write=vars(sys).update,
        kept=_same_objects,
    ),
    # Closed, a standard stream keeps its descriptor, and the next line that is printed is an error.
    Setting(
        name="whether standard input or output is closed",
        read=lambda: [stream is not None and stream.closed for stream in (sys.stdin, sys.stdout, sys.stderr)],
    ),
    Setting(
        name="the filters of warnings",
        read=lambda: list(warnings.filters),
        write=_put_filters,
        kept=_filters,
    ),
    Setting(name="the timeout of connections", read=socket.getdefaulttimeout, write=socket.setdefaulttimeout),
    Setting(
        name="the error state of numpy",
        read=lambda: dict(sys.modules["numpy"].geterr()),
        write=lambda value: sys.modules["numpy"].seterr(**value),
        module="numpy",
        usual=NUMPY,
    ),
    Setting(
        name="the default type of torch",
        read=lambda: str(_torch().get_default_dtype()),
        write=lambda value: _torch().set_default_dtype(getattr(_torch(), value.removeprefix("torch."))),
        module="torch",
        usual="torch.float32",
    ),
    Setting(
        name="the default device of torch",
        read=lambda: str(_torch().get_default_device()),
        write=lambda value: _torch().set_default_device(None),
        module="torch",
        usual="cpu",
    ),
    Setting(name="the modes of torch", read=_modes, module="torch", usual=(0, 0)),
    Setting(
        name="the gradient mode of torch",
        read=lambda: (_torch().is_grad_enabled(), _torch().is_inference_mode_enabled()),
        write=lambda value: _torch().set_grad_enabled(value[0]),
        module="torch",
        usual=(True, False),
    ),
    Setting(
        name="the hooks of all modules of torch",
        read=lambda: bool(_torch().nn.modules.module._has_any_global_hook()),
        module="torch",
        usual=False,
    ),
    Setting(
        name="the anomaly mode of torch",
        read=lambda: _torch().is_anomaly_enabled(),
        write=lambda value: _torch().autograd.set_detect_anomaly(value),
        module="torch",
        usual=False,
    ),
    Setting(
        name="the deterministic mode of torch",
        read=lambda: _torch().get_deterministic_debug_mode(),
        write=lambda value: _torch().set_deterministic_debug_mode(value),
        module="torch",
        usual=0,
    ),
    Setting(
        name="the precision of torch",
        read=lambda: _torch().get_float32_matmul_precision(),
        write=lambda value: _torch().set_float32_matmul_precision(value),
        module="torch",
        usual="highest",
    ),
    Setting(
        name="the threads of torch",
        read=lambda: _torch().get_num_threads(),
        write=lambda value: _torch().set_num_threads(value),
        module="torch",
    ),
)
"""What is compared before and after the import of a plug-in."""
ALONE = (
    Setting(name="open files of the process", read=_files, kept=_same_values),
    Setting(name="the threads that hold the end of the process", read=_threads),
)
"""What is compared in a copy of the process only, where nothing else runs."""
