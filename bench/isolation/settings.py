"""Settings of a process that all its components share: notices what foreign code changed, and puts it back."""

from __future__ import annotations

import builtins
import codecs
import copyreg
import gc
import locale
import multiprocessing
import multiprocessing.spawn
import operator
import os
import socket
import stat
import sys
import tempfile
import threading
import tracemalloc
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from cavbench.isolation.framework import LIBRARIES, OWN
from cavbench.isolation.setting import UNKNOWN, Setting, in_order, same_objects, same_values
from cavbench.isolation.system import SYSTEM

OURS = (
    *("PYTHON", "LD_PRELOAD", "LD_AUDIT", "DYLD_INSERT", "LC_", "LANG", "TZ", "HOME", "PATH", "TMP", "TEMP", "XDG_"),
    *("CAVBENCH_", "BENCH_"),
)
"""Beginnings of the names of environment variables that foreign code may neither add nor change."""
THEIRS = ("OMP_", "MKL_", "OPENBLAS_", "NUMBA_", "TORCH", "CUDA_")
"""The same for those that it may add: libraries do when they are imported. All others may change, and none may go."""
RECURSION = "the recursion limit"
BACKENDS = (
    *(("cudnn", name) for name in ("enabled", "deterministic", "benchmark", "allow_tf32")),
    ("mkldnn", "enabled"),
)
"""Flags of torch's backends that change numbers, by their modules in `torch.backends`."""
NUMPY = {"divide": "warn", "over": "warn", "under": "ignore", "invalid": "warn"}
AUTOCAST = "cpu", "cuda"


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


def _modules() -> dict[str, object]:
    """The modules of the framework, and those that scores are computed with."""
    found: dict[str, object] = {name: sys.modules[name] for name in LIBRARIES if name in sys.modules}
    # Thousands are imported, and hardly one is ours: the quick question comes first.
    found |= {
        name: module for name, module in sys.modules.items() if name.startswith(OWN) and name.partition(".")[0] == OWN
    }
    return found


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


def _stacked() -> tuple[Any, ...]:
    from cavbench.isolation.modes import stacked

    return stacked()


def _clear(before: Any) -> None:
    from cavbench.isolation.modes import clear

    clear(before)


def _backend(where: str) -> Any:
    return sys.modules[f"torch.backends.{where}"]


def _put_backends(before: Mapping[tuple[str, str], bool]) -> None:
    for (where, name), value in before.items():
        setattr(_backend(where), name, value)


def _put_autocast(before: Sequence[bool]) -> None:
    for device, enabled in zip(AUTOCAST, before, strict=True):
        _torch().set_autocast_enabled(device, enabled)


def _put_collector(before: tuple[bool, tuple[int, int, int], int]) -> None:
    (gc.enable if before[0] else gc.disable)()
    gc.set_threshold(*before[1])
    gc.set_debug(before[2])


def _put_temporary(before: str) -> None:
    tempfile.tempdir = before


def _put_program(before: tuple[str, Any]) -> None:
    sys.executable = before[0]
    multiprocessing.set_executable(before[1])


def _coders() -> dict[str, object]:
    names = ("strict", "ignore", "replace", "surrogateescape", "backslashreplace")
    return {name: codecs.lookup_error(name) for name in names}


def _put_coders(before: Mapping[str, Any]) -> None:
    for name, handler in before.items():
        codecs.register_error(name, handler)


def _streams() -> list[dict[str, Any]]:
    """How each standard stream writes: its encoding, and what an object of it has of its own, as a replaced method."""
    names = ("encoding", "errors", "line_buffering", "write_through")
    return [
        {"own": dict(getattr(stream, "__dict__", {})), **{name: getattr(stream, name, None) for name in names}}
        for stream in (sys.stdin, sys.stdout, sys.stderr)
    ]


def _put_streams(before: Sequence[Mapping[str, Any]]) -> None:
    for stream, found in zip((sys.stdin, sys.stdout, sys.stderr), before, strict=True):
        with suppress(Exception):
            vars(stream).clear()
            vars(stream).update(found["own"])
        with suppress(Exception):
            stream.reconfigure(**{name: value for name, value in found.items() if name != "own"})  # type: ignore[union-attr]


SETTINGS = (
    *SYSTEM,
    Setting(name=RECURSION, read=sys.getrecursionlimit, write=sys.setrecursionlimit),
    Setting(name="the switch interval of threads", read=sys.getswitchinterval, write=sys.setswitchinterval),
    Setting(name="the trace function", read=sys.gettrace, write=sys.settrace, kept=operator.is_),
    Setting(name="the profile function", read=sys.getprofile, write=sys.setprofile, kept=operator.is_),
    Setting(
        name="the trace function of new threads", read=threading.gettrace, write=threading.settrace, kept=operator.is_
    ),
    Setting(
        name="the profile function of new threads",
        read=threading.getprofile,
        write=threading.setprofile,
        kept=operator.is_,
    ),
    Setting(name="the stack of new threads", read=threading.stack_size, write=threading.stack_size),
    Setting(name="whether memory is traced", read=tracemalloc.is_tracing, write=lambda _: tracemalloc.stop()),
    Setting(
        name="the most digits of a number",
        read=lambda: sys.get_int_max_str_digits(),
        write=lambda value: sys.set_int_max_str_digits(value),
    ),
    Setting(
        name="the garbage collector",
        read=lambda: (gc.isenabled(), gc.get_threshold(), gc.get_debug()),
        write=_put_collector,
    ),
    Setting(name="environment variables", read=lambda: dict(os.environ), write=_put_environment, kept=_environment),
    # What replaces it changes no environment of a process.
    Setting(
        name="what holds environment variables",
        read=lambda: os.environ,
        write=lambda value: setattr(os, "environ", value),
        kept=operator.is_,
    ),
    Setting(name="the folder for temporary files", read=tempfile.gettempdir, write=_put_temporary),
    Setting(
        name="the program of Python",
        read=lambda: (sys.executable, multiprocessing.spawn.get_executable()),
        write=_put_program,
    ),
    Setting(name="how text is encoded", read=_coders, write=_put_coders, kept=same_objects),
    Setting(
        name="how objects are pickled",
        read=lambda: dict(copyreg.dispatch_table),
        write=copyreg.dispatch_table.update,
        kept=same_objects,
    ),
    Setting(
        name="the locale",
        read=lambda: locale.setlocale(locale.LC_ALL),
        write=lambda value: locale.setlocale(locale.LC_ALL, value),
    ),
    Setting(
        name="the import path",
        read=lambda: list(sys.path),
        write=lambda value: sys.path.__setitem__(slice(None), value),
        kept=in_order,
    ),
    Setting(
        name="how Python imports",
        read=lambda: list(sys.meta_path),
        write=lambda value: sys.meta_path.__setitem__(slice(None), value),
        kept=in_order,
    ),
    Setting(
        name="how Python finds modules",
        read=lambda: list(sys.path_hooks),
        write=lambda value: sys.path_hooks.__setitem__(slice(None), value),
        kept=in_order,
    ),
    Setting(name="modules of the framework", read=_modules, write=sys.modules.update, kept=same_objects),
    Setting(
        name="functions of Python",
        read=lambda: {name: value for name, value in vars(builtins).items() if name != "_"},
        write=vars(builtins).update,
        kept=same_objects,
    ),
    Setting(
        name="standard input or output",
        read=lambda: {name: getattr(sys, name) for name in ("stdin", "stdout", "stderr")},
        write=vars(sys).update,
        kept=same_objects,
    ),
    Setting(name="how standard input or output writes", read=_streams, write=_put_streams),
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
    Setting(
        name="how warnings are shown",
        read=lambda: {name: vars(warnings).get(name) for name in ("showwarning", "formatwarning")},
        write=vars(warnings).update,
        kept=same_objects,
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
    # A default device is one.
    Setting(
        name="the modes of torch",
        read=_stacked,
        write=_clear,
        module="torch",
        usual=(0, 0, 0, 0, False, (0,) * 4, frozenset()),
    ),
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
        name="the automatic types of torch",
        read=lambda: [_torch().is_autocast_enabled(device) for device in AUTOCAST],
        write=_put_autocast,
        module="torch",
        usual=[False] * len(AUTOCAST),
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
        name="the backends of torch",
        read=lambda: {(where, name): getattr(_backend(where), name) for where, name in BACKENDS},
        write=_put_backends,
        module="torch",
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
    Setting(name="open files of the process", read=_files, kept=same_values),
    Setting(name="the threads that hold the end of the process", read=_threads),
)
"""What is compared in a copy of the process only, where nothing else runs."""
