"""A worker process: carries out one task after the other, and is replaced when a task hangs, ends it or changes it.

What components print is kept apart from the terminal and from the tables: it comes back as lines of text.
"""

from __future__ import annotations

import _thread
import gc
import importlib
import multiprocessing
import os
import pickle
import signal
import tempfile
import time
from contextlib import ExitStack, suppress
from dataclasses import replace
from multiprocessing.connection import Connection, wait
from typing import Any

from cavbench import files
from cavbench.errors import reason
from cavbench.identity.fingerprint import code_digest, told
from cavbench.isolation import tree
from cavbench.isolation.foreign import contained, ended
from cavbench.isolation.framework import Snapshot
from cavbench.isolation.settings import Settings
from cavbench.run.attempt import attempt
from cavbench.run.blame import blamed
from cavbench.run.process import children, follow_parent, settle
from cavbench.run.server import server, work_modules
from cavbench.run.task import Limits, Outcome, Task, Tell

GB = 1e9
READY = "ready"
START_S = 600.0
"""Seconds that a worker may take to start: on a busy machine its imports take long."""
KEPT_BYTES = 8192
"""Bytes that are kept of what a task prints."""


class Worker:
    """A worker process, as its parent sees it. Start it from a thread that lives as long as the parent.

    Args:
        limits: of each task.

    `busy` says whether it has a task, `spent` whether it can do no other task: it is dead, hangs, or was changed.
    """

    def __init__(self, limits: Limits) -> None:
        own = server()
        self.limits = limits
        self.busy = self.ready = self.spent = False
        self.heard, self.printed = True, b""
        self.told: dict[tuple[str, ...], str] = {}
        self.known: set[tree.Identity] = set()
        self.connection, far = multiprocessing.Pipe()
        self.output, end = multiprocessing.Pipe(duplex=False)
        # Temporary files are counted, and deleted with the worker.
        self.scratch = ExitStack()
        self.folder = self.scratch.enter_context(files.scratch())
        environment = dict(os.environ) | {"TMPDIR": str(self.folder)}
        # Not daemonic: components may start processes of their own.
        self.process = own.Process(target=_serve, args=(far, end, environment), daemon=False)  # type: ignore[attr-defined]
        self.process.start()
        self.born = time.monotonic()
        far.close()
        end.close()

    def give(self, content: bytes, task: Task | None = None) -> None:
        """Start a task, from `packed`; the worker is told the code digest of a `task` that was planned on this machine."""
        self.busy, self.started, self.printed = True, time.monotonic(), b""
        modules = task.unit.modules if task and task.step == "drive" else ()
        digests = {modules: code_digest(modules)} if modules and modules not in self.told else {}
        self.told |= digests
        # A worker that died meanwhile is noticed when it is asked for news.
        with suppress(OSError):
            self.connection.send_bytes(pickle.dumps(digests))
            self.connection.send_bytes(content)

    @property
    def sources(self) -> list[Connection | int]:
        """What to wait for: news, what is printed, and the end of the process."""
        heard = [self.output] if self.heard else []
        return [self.connection, *heard, self.process.sentinel]

    def wait(self, seconds: float) -> None:
        """Wait until there is news, or for so long."""
        wait(self.sources, seconds)

    def news(self) -> list[Any]:
        """What the worker sent since: progress as (task, share, text, episodes); at the end of a task its outcome.

        A worker that died, or used more time or memory than allowed, has failed its task, and is `spent`.
        """
        found: list[Any] = []
        # Ask before reading: what it sent before it died is still there.
        died = not self.process.is_alive()
        try:
            while self.connection.poll():
                found.append(pickle.loads(self.connection.recv_bytes()))
        except (EOFError, OSError):
            died = True
        self._listen()
        if self.busy:
            # If the worker ends, they are nobody's.
            self.known |= tree.identities(self.process.pid or 0)
        if READY in found:
            # Its imports do not count.
            found.remove(READY)
            self.ready, self.started = True, time.monotonic()
        ends = [item for item in found if isinstance(item, Outcome)]
        if self.busy and not ends and (why := self._death() if died else self._excess()):
            ends = [Outcome(why=f"failed: {why}", lost=True, died=died)]
            found += ends
        if ends:
            self.busy = False
            # What failed may have left anything behind; the next task starts in a new process.
            self.spent = died or any(_is_harmful(part) for item in ends for part in (item, *item.others))
        return found

    def lines(self) -> list[str]:
        """The lines that its task printed; only the first `KEPT_BYTES` are kept."""
        self._listen()
        text = self.printed[:KEPT_BYTES].decode(errors="replace")
        return [line.rstrip() for line in text.splitlines() if line.strip()]

    def kill(self) -> None:
        """End the process, and those that its components started, also in sessions of their own."""
        if self.process.is_alive():
            tree.kill(self.process.pid or 0)
        for one in self.known:
            one.kill()
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self.process.pid or 0, signal.SIGKILL)
        self.process.kill()
        self.process.join()

    def close(self) -> None:
        """End the process, and close the connections."""
        self.kill()
        self.connection.close()
        self.output.close()
        # Something may still write to it; the next command deletes what is left.
        with suppress(OSError):
            self.scratch.close()

    def _listen(self) -> None:
        """Read what was printed, and forget what is too much."""
        with suppress(EOFError, OSError):
            while self.output.poll():
                content = os.read(self.output.fileno(), 1 << 16)
                if not content:
                    self.heard = False
                    return
                self.printed += content[: max(0, KEPT_BYTES - len(self.printed))]

    def _death(self) -> str:
        self.process.join(10)
        code = self.process.exitcode
        hint = ", perhaps for want of memory" if code == -signal.SIGKILL else ""
        last = self.lines()[-1:]
        words = f"; its last words: {last[0][:200]}" if last else ""
        return f"it ended its worker process ({'unknown' if code is None else ended(code)}{hint}){words}"

    def _excess(self) -> str:
        """What the task used too much of; empty if nothing."""
        if not self.ready:
            late = time.monotonic() - self.born > START_S
            return f"its worker process did not start within {START_S:g} seconds" if late else ""
        if self.limits.seconds and time.monotonic() - self.started > self.limits.seconds:
            return f"it took longer than unit_timeout={self.limits.seconds:g} seconds"
        used = tree.used_bytes(self.process.pid or 0, self.folder) / GB if self.limits.memory_gb else 0
        if used > self.limits.memory_gb:
            return f"it used {used:.1f} GB of memory, more than unit_memory={self.limits.memory_gb:.3g} GB"
        return ""


def _is_harmful(item: Outcome) -> bool:
    """Whether the process that this came of must do no other task."""
    return not item.bad_input if item.failed else item.last


def packed(task: Task) -> bytes | Outcome:
    """A task as a worker is sent it; a failure if a component does not survive pickling."""
    try:
        with contained():
            return pickle.dumps(task, pickle.HIGHEST_PROTOCOL)
    # A plug-in's own way of being pickled may raise anything.
    except Exception as error:
        return Outcome(why=f"failed: it cannot be sent to a worker: {reason(error)}{blamed(task.pair, error)}")


def _serve(connection: Connection, output: Connection, environment: dict[str, str]) -> None:
    """The worker process: carry out tasks until the parent hangs up."""
    follow_parent()
    tree.adopt()
    # A fork server has the environment of its own start.
    os.environ.clear()
    os.environ.update(environment)
    tempfile.tempdir = environment["TMPDIR"]
    # Components may start processes of their own: the group ends with the worker.
    with suppress(OSError):
        os.setpgid(0, 0)
    own = os.getpid()
    for stream in (1, 2):
        os.dup2(output.fileno(), stream)
    output.close()
    settle()
    for module in work_modules():
        importlib.import_module(module)
    # The server did without, and what it imported is no garbage.
    gc.freeze()
    gc.enable()
    # Before any plug-in is imported.
    before = Snapshot()
    settings, started = Settings(alone=True), _running()
    connection.send_bytes(pickle.dumps(READY))

    def tell(task: str, share: float, text: str, episodes: int = 0) -> None:
        # A copy of this process may prepare something, too.
        if os.getpid() != own:
            os._exit(1)
        connection.send_bytes(pickle.dumps((task, share, text, episodes)))

    while True:
        try:
            told().update(pickle.loads(connection.recv_bytes()))
            content = connection.recv_bytes()
        except (EOFError, OSError):
            if os.getpgrp() == own:
                os.killpg(0, signal.SIGKILL)
            return
        outcome = _carried_out(content, tell, before)
        if not outcome.failed and (_left(started) or settings.changed()):
            outcome = replace(outcome, last=True)
        connection.send_bytes(pickle.dumps(outcome, pickle.HIGHEST_PROTOCOL))


def _running() -> tuple[frozenset[int], int]:
    """The processes that this one started, and the number of its threads."""
    return children(), _thread._count()


def _left(before: tuple[frozenset[int], int]) -> bool:
    """Whether a task left a process, which could disturb the next component, or a thread, which would count against it."""
    try:
        processes, threads = _running()
    # With a low limit of open files, nothing can be read.
    except OSError:
        return True
    return processes != before[0] or threads > before[1]


def _carried_out(content: bytes, tell: Tell, before: Snapshot) -> Outcome:
    try:
        with contained():
            task: Task = pickle.loads(content)
    # Unpickling imports the plug-ins.
    except Exception as error:
        return Outcome(why=f"failed: a worker cannot load it: {reason(error)}")
    return attempt(task, tell, before)
