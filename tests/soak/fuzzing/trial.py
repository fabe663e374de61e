"""Reads changed files in a process that may end, hang or grow, and says what happened."""

from __future__ import annotations

import ctypes
import faulthandler
import gc
import multiprocessing
import os
import resource
import sys
import tempfile
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from types import FrameType
from typing import Any, Literal

import psutil

CPU_S, WALL_S, STUCK_S = 20.0, 240.0, 20.0
"""Most seconds of a core, and of the clock, that a small file may take; after the last without any work it is tried again."""
MOST_MB, ROOM = 600, 4 * 2**30
"""Memory that reading a small file may take, and the address space that it could take."""
OUTSIDE = (
    *("os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "os.forkpty", "subprocess.Popen", "pty.spawn"),
    *("socket.connect", "socket.bind", "socket.sendto", "urllib.Request", "pickle.find_class"),
    *("ctypes.dlopen", "code.__new__", "os.kill", "webbrowser.open"),
)
"""Events of Python's audit hook that reading a file has no reason for."""
WRITES = (
    "os.remove",
    "os.rename",
    "os.rmdir",
    "os.mkdir",
    "os.link",
    "os.symlink",
    "os.truncate",
    "os.chmod",
    "shutil.rmtree",
)
Kind = Literal["read", "refused", "crashed", "wrong"]


@dataclass(frozen=True)
class Verdict:
    """What happened to a file: it was read, refused in one line, ended the copy of the process that tries it, or went wrong.

    Args:
        kind: which.
        text: the line, or what went wrong.
    """

    kind: Kind
    text: str = ""


class Trials:
    """Reads one file after the other in one process; a new one follows where it ended.

    Args:
        read: reads the files in a folder.
        refusals: what it may raise, with a message of one line.
        guarded: whether the program itself reads such a file in a copy of its process first, which may crash: the user then sees
            one line.
    """

    def __init__(
        self, read: Callable[[Path], object], refusals: tuple[type[Exception], ...], *, guarded: bool = False
    ) -> None:
        self._read, self._refusals, self._guarded = read, refusals, guarded
        self._process: multiprocessing.process.BaseProcess | None = None
        self._pipe: Connection | None = None
        self._place = tempfile.TemporaryDirectory()

    def __enter__(self) -> Trials:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()
        self._place.cleanup()

    def tried(self, files: Mapping[str, bytes]) -> Verdict:
        """Write files into a folder, and read them."""
        with tempfile.TemporaryDirectory(dir=self._place.name) as folder:
            for name, content in files.items():
                path = Path(folder, name)
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(content)
            # A copy of a process with threads may be stuck from the start.
            return self._asked(folder) or self._asked(folder) or Verdict("wrong", "it does nothing, and does not end")

    def _asked(self, folder: str) -> Verdict | None:
        """The verdict of the process; None if it does no work."""
        if self._process is None or self._pipe is None:
            self._begin()
        assert self._process is not None
        assert self._pipe is not None
        self._pipe.send(folder)
        with suppress(psutil.NoSuchProcess):
            # A process that has ended answers by the end of its pipe.
            if (why := self._waited(psutil.Process(self._process.pid or 0))) is not None:
                self._end()
                return Verdict("wrong", why) if why else None
        try:
            verdict: Verdict = self._pipe.recv()
            if verdict.kind == "wrong":
                # It may not be as it was.
                self._end()
            return verdict
        except EOFError:
            self._process.join()
            code = self._process.exitcode
            self._end()
            return (
                Verdict("crashed", f"ends a copy ({code})")
                if self._guarded
                else Verdict("wrong", f"ends the process ({code})")
            )

    def _waited(self, process: psutil.Process) -> str | None:
        """Wait for an answer: None if there is one, else why not; empty if the process does not work."""
        assert self._pipe is not None
        begin = before = sum(process.cpu_times()[:2])
        waited = idle = 0.0
        while not self._pipe.poll(0.5):
            now = sum(process.cpu_times()[:2])
            waited, idle = waited + 0.5, idle + 0.5 if now == before else 0.0
            before = now
            if idle >= STUCK_S:
                return ""
            if now - begin > CPU_S or waited > WALL_S:
                return f"it takes more than {now - begin:.0f} s of a core"
        return None

    def _begin(self) -> None:
        context = multiprocessing.get_context("fork")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=self._served, args=(theirs,), daemon=True)
        self._process.start()
        theirs.close()

    def _end(self) -> None:
        if self._process is not None and self._pipe is not None:
            self._process.kill()
            self._process.join()
            self._pipe.close()
        self._process = self._pipe = None

    def _served(self, pipe: Connection) -> None:
        """In the other process: read what is asked for, and answer."""
        gc.freeze()
        faulthandler.disable()
        if "torch" in sys.modules:
            # The threads of the parent are not in this copy: waiting for them would never end.
            sys.modules["torch"].set_num_threads(1)
        silence = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(silence, stream)
        size = psutil.Process().memory_info().vms + ROOM
        resource.setrlimit(resource.RLIMIT_AS, (size, size))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        tempfile.tempdir = self._place.name
        sys.dont_write_bytecode = True
        # Memory that this process has freed and kept would hide what a reader takes.
        trim = getattr(ctypes.CDLL(None), "malloc_trim", lambda _: 0)
        done: list[str] = []
        sys.addaudithook(
            lambda event, arguments: (
                done.append(f"{event} {str(arguments)[:200]}") if self._bad(event, arguments) else None
            )
        )
        while True:
            folder = pipe.recv()
            trim(0)
            before = _memory(reset=True)
            done.clear()
            verdict = self._verdict(Path(folder))
            events = list(done)
            grown = _memory() - before
            if events:
                verdict = Verdict("wrong", f"it does {events[0]}")
            elif grown > MOST_MB:
                verdict = Verdict("wrong", f"it takes {grown:.0f} MB ({verdict.kind} {verdict.text})")
            pipe.send(verdict)

    def _bad(self, event: str, arguments: tuple[Any, ...]) -> bool:
        if event == "pickle.find_class" and _reads_compiled_code():
            return False
        if event == "ctypes.dlopen" and arguments[0] is None:
            # The process itself, which libraries open when they are imported.
            return False
        if event == "open" and isinstance(arguments[0], str) and isinstance(arguments[2], int):
            writes = bool(arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
            return writes and not arguments[0].startswith((self._place.name, "/dev/null"))
        if event in WRITES:
            return (
                isinstance(arguments[0], str)
                and os.path.isabs(arguments[0])
                and not arguments[0].startswith(self._place.name)
            )
        return event in OUTSIDE

    def _verdict(self, folder: Path) -> Verdict:
        try:
            self._read(folder)
        except self._refusals as error:
            text = str(error)
            return Verdict("refused" if text and len(text.splitlines()) == 1 else "wrong", text)
        except BaseException:
            return Verdict("wrong", traceback.format_exc())
        return Verdict("read")


def _memory(*, reset: bool = False) -> float:
    """The most memory of this process in MB, since it was reset."""
    if reset:
        Path("/proc/self/clear_refs").write_text("5")
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1000


def _reads_compiled_code() -> bool:
    """Whether numba reads what it has compiled of our own code before, from its cache."""
    frame: FrameType | None = sys._getframe()
    while frame is not None:
        if frame.f_code.co_filename.endswith(os.path.join("numba", "core", "caching.py")):
            return True
        frame = frame.f_back
    return False
