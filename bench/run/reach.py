"""Files while plug-ins are measured: what a plug-in writes in one unit, it could read in another, also in a later run.

Python tells an audit hook of every file that its code opens (PEP 578). Libraries that write by themselves are told of where that
is possible (`_announced`). It is no sandbox: code that opens files outside of Python is not seen.
"""

from __future__ import annotations

import importlib
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache
from pathlib import Path
from types import FrameType
from typing import Any

from cavbench import files
from cavbench.core.pair import Chosen, Pair
from cavbench.identity.fingerprint import OWN, PARTS
from cavbench.isolation.watch import TamperError
from cavbench.run.unit import is_foreign

WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
CHANGES = frozenset(
    [
        "os.mkdir",
        "os.rename",
        "os.remove",
        "os.rmdir",
        "os.link",
        "os.symlink",
        "os.truncate",
        "os.utime",
        "os.setxattr",
    ]
)
"""Events that change what is on the disk; the first argument is a path, of some the second one, too."""
TWO = frozenset(["os.rename", "os.link", "os.symlink"])
DATABASES = frozenset(["sqlite3.connect", "dbm.open"])
TOLD = frozenset(["socket.connect", "socket.sendto"])
SHARED = "multiprocessing.shared_memory"
"""The module through which Python shares memory with other processes."""
CARRIERS = (
    *("numpy", "safetensors", "pandas", "PIL", "h5py", "joblib", "pyarrow", "tensordict", "cloudpickle", "yaml"),
    *("torch.serialization", "torch.storage", "torch.utils._cpp_embed_headers"),
)
"""Libraries that open what they are told to open: who told them counts."""
IMPORTS = ("importlib", "_frozen_importlib", "_frozen_importlib_external", "zipimport", "pkgutil", "linecache")
"""Modules of Python that open files by themselves."""
SINKS = ("/dev/null", "/dev/stdout", "/dev/stderr", "/dev/tty", "/dev/pts/", "/proc/")
RULE = "a plug-in may keep no memory across units"


@dataclass
class _Watched:
    """What is watched at the moment.

    Args:
        packages: top-level packages of plug-ins.
        scratch: the temporary folder of the unit.
        readable: folders and files that plug-ins may read.
        private: folders in which they may read nothing else.
        found: why the unit is refused.
    """

    packages: frozenset[str]
    scratch: str
    readable: tuple[str, ...]
    private: tuple[str, ...]
    found: list[str] = field(default_factory=list)


_watched: _Watched | None = None


@contextmanager
def within_reach(pairs: Sequence[Pair]) -> Iterator[None]:
    """Refuse what plug-ins write outside of a temporary folder of their own, or read in the working folder.

    Args:
        pairs: attack, defence, victim, world, threat model.

    Raises:
        TamperError: at once, and again at the end if it was caught.
    """
    global _watched
    parts = [part for pair in pairs for part in pair.parts]
    foreign = [part for part in parts if is_foreign(part) and not part.code]
    if not foreign or _watched is not None:
        yield
        return
    _install()
    before = tempfile.tempdir, os.environ.get("TMPDIR")
    outer = tempfile.gettempdir()
    with files.scratch() as scratch:
        watched = _Watched(
            packages=frozenset(type(part.component).__module__.partition(".")[0] for part in foreign),
            scratch=_real(scratch),
            readable=_readable(foreign, parts),
            private=tuple(_real(folder) for folder in (_folder(), outer, "/dev/shm")),
        )
        tempfile.tempdir = os.environ["TMPDIR"] = str(scratch)
        _watched = watched
        try:
            yield
        finally:
            _watched = None
            tempfile.tempdir = before[0]
            os.environ.pop("TMPDIR", None)
            if before[1] is not None:
                os.environ["TMPDIR"] = before[1]
    if watched.found:
        raise TamperError(watched.found[0])


def _heard(event: str, arguments: tuple[Any, ...]) -> None:
    """The audit hook. It cannot be removed, so it costs next to nothing where nothing is watched."""
    watched = _watched
    if watched is None:
        return
    if event == "open":
        path, mode, flags = arguments
        writes = bool(flags & WRITES) if mode is None else any(letter in str(mode) for letter in "wax+")
        _judge(watched, path, writes)
    elif event in CHANGES or event in DATABASES:
        for path in arguments[:2] if event in TWO else arguments[:1]:
            _judge(watched, path, True)
    elif event in TOLD:
        address = arguments[1]
        if isinstance(address, tuple) and _asking(watched):
            _refuse(watched, f"it connected to {address[0]} while it was measured")
    elif event == "mmap.__new__" and (sharing := _frame_of(SHARED)) and _asking(watched):
        _unlink(sharing)
        _refuse(watched, "it shared memory with other processes while it was measured")


def _judge(watched: _Watched, path: object, writes: bool) -> None:
    if not isinstance(path, str | bytes | os.PathLike):
        return  # A descriptor that is open already.
    name = os.fsdecode(path)
    where = _real(name)
    if where.startswith(SINKS) or _lies_in(where, (watched.scratch,)):
        return
    if not writes and (not _lies_in(where, watched.private) or _lies_in(where, watched.readable)):
        return
    if (not writes and not os.path.isfile(where)) or not _asking(watched, if_unknown=writes):
        return
    shown = os.path.relpath(where) if _lies_in(where, (_real(_folder()),)) else where
    _refuse(watched, f"it {'wrote' if writes else 'read'} {shown} while it was measured")


def _refuse(watched: _Watched, what: str) -> None:
    why = f"{what}: {RULE}"
    watched.found.append(why)
    raise TamperError(why)


def _asking(watched: _Watched, if_unknown: bool = True) -> bool:
    """Whether a plug-in opens the file: the innermost code that is neither Python's nor a carrier's is a plug-in's."""
    frame: FrameType | None = sys._getframe(2)
    while frame is not None:
        module = frame.f_globals.get("__name__") or ""
        top = module.partition(".")[0]
        if top in watched.packages:
            return True
        if frame.f_code is _heard.__code__ or module == __name__ or _carries(module, top):
            frame = frame.f_back
            continue
        return False
    return if_unknown


@cache
def _carries(module: str, top: str) -> bool:
    if module.startswith(IMPORTS):
        return False
    return top in sys.stdlib_module_names or any(module == one or module.startswith(f"{one}.") for one in CARRIERS)


def _frame_of(module: str) -> FrameType | None:
    """The innermost frame of a module's code; None if none runs."""
    frame: FrameType | None = sys._getframe(1)
    while frame is not None and frame.f_globals.get("__name__") != module:
        frame = frame.f_back
    return frame


def _unlink(sharing: FrameType) -> None:
    """Remove the shared memory that is being made: that it is there would be a memory, too."""
    if sharing.f_locals.get("create"):
        with suppress(Exception):
            sharing.f_locals["self"].unlink()


def _readable(foreign: Sequence[Chosen[Any]], parts: Sequence[Chosen[Any]]) -> tuple[str, ...]:
    """Installed packages, caches of libraries, and what parameters name."""
    home = Path.home()
    found = [sys.prefix, sys.base_prefix, os.environ.get("XDG_CACHE_HOME", home / ".cache")]
    found += [os.environ[name] for name in ("TORCH_HOME", "HF_HOME", "NUMBA_CACHE_DIR") if name in os.environ]
    own = (OWN, *(f"{OWN}.{part}" for part in PARTS))
    for name in (*own, *(type(part.component).__module__.partition(".")[0] for part in foreign)):
        module = sys.modules.get(name)
        found += list(getattr(module, "__path__", None) or filter(None, [getattr(module, "__file__", None)]))
    found += [value for part in parts for value in _paths(part.component)]
    return tuple(_real(path) for path in found)


def _paths(component: Any) -> Iterator[str]:
    """The parameters of a component that name a file or a folder; of its parts, too."""
    for one in fields(component) if is_dataclass(component) else ():
        value = getattr(component, one.name)
        if isinstance(value, str | os.PathLike) and str(value) and os.path.exists(value):
            yield os.fspath(value)
        elif is_dataclass(value):
            yield from _paths(value)


def _lies_in(path: str, folders: Sequence[str]) -> bool:
    return any(path == folder or path.startswith(f"{folder}{os.sep}") for folder in folders)


def _real(path: str | os.PathLike[str]) -> str:
    return os.path.realpath(path)


def _folder() -> str:
    try:
        return os.getcwd()
    except OSError:
        return os.sep


@cache
def _install() -> None:
    sys.addaudithook(_heard)
    _announced("torch._C", "PyTorchFileWriter")
    for module in ("safetensors.torch", "safetensors.numpy"):
        _announced(module, "serialize_file", place=1)


def _announced(module: str, name: str, place: int = 0) -> None:
    """Let a function that opens a file outside of Python say so; its path is the argument number `place`."""
    try:
        owner = importlib.import_module(module)
        own = getattr(owner, name)
    except (ImportError, AttributeError):
        return

    def opening(*arguments: Any, **more: Any) -> Any:
        if len(arguments) > place and isinstance(arguments[place], str | os.PathLike):
            sys.audit("open", arguments[place], "wb", 0)
        return own(*arguments, **more)

    setattr(owner, name, opening)
