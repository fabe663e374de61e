"""Runs foreign code that must not end this process: what it raises, and what it does when it is imported."""

from __future__ import annotations

import atexit
import faulthandler
import gc
import importlib
import os
import select
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from io import FileIO
from pathlib import Path
from types import FrameType

from cavbench.errors import EscapeError, Notice, reason
from cavbench.isolation import tree
from cavbench.isolation.framework import Snapshot
from cavbench.isolation.settings import RECURSION, Settings

HARM_S = 120
"""Seconds that the import of a module, or reading a file, may take, besides those that it waits for a core."""
STUCK_S = 15.0
"""Seconds without work after which a copy is taken for stuck, and made once more."""
END_S = 5.0
"""Seconds that the hooks may take that a module leaves for the end of the process."""
SURVIVED, ENDED = b"survived", b"."
CLOSED = 113
"""Exit code of a copy that cannot report, because what it reports to was closed."""


class StopUnitError(BaseException):
    """The run itself stops foreign code by this exception; no foreign code should catch it."""


@contextmanager
def contained() -> Iterator[None]:
    """Run foreign code that must not end this process by an exception, nor copy it.

    A copy that it makes by `os.fork` ends here: two processes must not do one work. The user's Ctrl-C goes through, even if the
    foreign code catches it.

    Raises:
        EscapeError: for a SystemExit, a GeneratorExit, a KeyboardInterrupt that is not the user's, and any other exception that
            is no `Exception`.
    """
    pressed, own = False, os.getpid()

    def press(number: int, frame: FrameType | None) -> None:
        nonlocal pressed
        pressed = True
        raise KeyboardInterrupt

    # Ctrl-C reaches the main thread only; worker processes ignore it.
    listens = threading.current_thread() is threading.main_thread() and callable(signal.getsignal(signal.SIGINT))
    before = signal.signal(signal.SIGINT, press) if listens else None
    try:
        yield
    except (Exception, StopUnitError):
        raise
    except BaseException as error:
        if pressed and isinstance(error, KeyboardInterrupt):
            raise
        raise EscapeError(reason(error)) from error
    finally:
        if os.getpid() != own:
            os._exit(1)
        if listens:
            signal.signal(signal.SIGINT, before)
    if pressed:
        raise KeyboardInterrupt


@contextmanager
def unchanged() -> Iterator[None]:
    """Run foreign code that must not change the settings of this process. They are put back.

    Raises:
        EscapeError: if it does; names the settings.
    """
    before, limit, changed = Settings(), sys.getrecursionlimit(), ""
    try:
        yield
    finally:
        # First of all: with a low limit, nothing else could be called.
        lowered = sys.getrecursionlimit()
        sys.setrecursionlimit(limit)
        # Nothing says whether it waits to end the process.
        faulthandler.cancel_dump_traceback_later()
        changed = RECURSION if lowered != limit else before.changed()
        if changed:
            before.restore()
        # A filter of the foreign code stays, but hides no line of ours.
        warnings.simplefilter("always", Notice)
    if changed:
        raise EscapeError(f"it changes {changed}")


def harm(act: Callable[[], object], seconds: float = HARM_S, *, stays: bool = False) -> str:
    """Do something in a copy of this process, and say what that does to the copy; empty if it does no harm.

    Exceptions are no harm: the same act in this process reports them.

    Args:
        act: imports a module, or reads a file.
        seconds: how long it may take.
        stays: whether what it does stays in a process, as a module does: then the settings of the process must be as before,
            its hooks for the end of the process must end, and no process that it started may be left after them.

    Returns:
        That it ends the process, does not end, replaces functions of the framework, changes settings, or leaves something; empty
        without `os.fork`.
    """
    if sys.platform != "linux":
        return ""
    found = _tried(act, seconds, stays, STUCK_S)
    # A lock that another thread held at the moment of the copy is never released there; a second copy hardly meets it again.
    return _tried(act, seconds, stays, seconds) or "" if found is None else found


def _tried(act: Callable[[], object], seconds: float, stays: bool, stuck: float) -> str | None:
    """What `harm` says of one copy of this process; None if the copy does nothing for `stuck` seconds."""
    read, write = os.pipe()
    child = _copied()
    if not child:
        _act_and_end(act, write, stays)
    os.close(write)
    with os.fdopen(read, "rb", buffering=0) as pipe:
        deadline = time.monotonic() + seconds
        said = _reported(pipe, child, deadline, stuck)
        late = time.monotonic() >= deadline + _delay(child)
        reported = bool(said and said.startswith(SURVIVED))
        left = _left(said, pipe) if said and reported and stays else ""
    started = tree.identities(child)
    if said == b"":
        # It ends by itself, and its exit code says why.
        _wait(child, END_S)
    # What it started ends, too.
    for process in started:
        process.kill()
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(child, signal.SIGKILL)
    if said is None or left:
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    if said is None:
        return f"does not end within {seconds:g} s" if late else None
    if not reported:
        code = os.waitstatus_to_exitcode(status)
        return "closes files of the process" if code == CLOSED else f"ends the process ({ended(code)})"
    return said.removeprefix(SURVIVED).partition(b"\n")[0].decode(errors="replace") or left


def _left(said: bytes, pipe: FileIO) -> str:
    """What a copy that has reported leaves at its end; empty if nothing."""
    after = said.partition(b"\n")[2] or _said(pipe, END_S + tree.LEFT_S)
    if after is None:
        return f"leaves a hook for the end of the process that does not end within {END_S:g} s"
    if not after:
        # The exit code of the command would be the hook's.
        return "leaves a hook for the end of the process that ends it at once"
    names = after.removeprefix(ENDED).decode(errors="replace")
    return f"leaves a process that outlives the command ({names})" if names else ""


def _copied() -> int:
    """Copy this process: 0 in the copy, its number here.

    In the copy, garbage of this process is never collected: what it does at its end may wait for a thread that is not there.
    """
    collects = gc.isenabled()
    gc.disable()
    try:
        with warnings.catch_warnings():
            # Python warns of threads in the parent; the child does this one thing and ends.
            warnings.simplefilter("ignore", DeprecationWarning)
            child = os.fork()
        if not child:
            gc.freeze()
    finally:
        if collects:
            gc.enable()
    return child


def _reported(pipe: FileIO, child: int, deadline: float, stuck: float) -> bytes | None:
    """What the copy writes until it ends or reports; None at the deadline, or if it does nothing for `stuck` seconds.

    The deadline moves while the copy waits for a core: on a busy machine it may get a tenth of one.
    """
    work, since = _work(child), time.monotonic()
    while (now := time.monotonic()) < (end := min(deadline + _delay(child), since + stuck)):
        if (said := _said(pipe, min(end, now + 1) - now)) is not None:
            return said
        if (done := _work(child)) != work:
            work, since = done, time.monotonic()
    return None


def _delay(process: int) -> float:
    """Seconds that the first thread of a process was ready and had no core (schedstats of the kernel); 0 if nothing says."""
    try:
        return int(Path(f"/proc/{process}/schedstat").read_text().split()[1]) / 1e9
    except (OSError, IndexError, ValueError):
        return 0.0


def _work(process: int) -> list[str]:
    """The time of a core that a process and its ended children used: four counters of the kernel."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(") ")[2].split()[11:15]
    except OSError:
        return []


def _wait(child: int, seconds: float) -> None:
    """Wait until a process has ended, or for so long; its end can still be read."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline and not os.waitid(os.P_PID, child, os.WEXITED | os.WNOWAIT | os.WNOHANG):
        time.sleep(0.01)


def _act_and_end(act: Callable[[], object], write: int, stays: bool) -> None:
    """In the copy: do it without a word on the terminal, report, and end."""
    code, own = 0, os.getpid()
    try:
        os.setsid()
        tree.adopt()
        silence = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(silence, stream)
        if stays:
            # Its constants can only be compared if they were there before. Plug-ins import most of it, too.
            importlib.import_module("cavbench.envs.highway.world")
        if "torch" in sys.modules:
            # The threads of the parent are not in the copy: waiting for them would never end.
            sys.modules["torch"].set_num_threads(1)
        # A crash is reported in our own words.
        faulthandler.disable()
        # The hooks of this process are not the module's.
        atexit._clear()
        framework, settings, limit = Snapshot(), Settings(alone=True), sys.getrecursionlimit()
        hooked: list[str] = []
        # Nothing lists the audit hooks, but each is told of later ones.
        sys.addaudithook(lambda event, _: hooked.append(event) if event == "sys.addaudithook" else None)
        with suppress(BaseException):
            act()
        if os.getpid() != own:
            return
        lowered = sys.getrecursionlimit()
        sys.setrecursionlimit(limit)
        found = ""
        if stays and (changed := RECURSION if lowered != limit else settings.changed()):
            found = f"changes {changed}"
        elif replaced := framework.changed():
            found = f"replaces {replaced}"
        elif stays and hooked:
            found = "adds an audit hook, which cannot be removed"
        code = CLOSED
        os.write(write, SURVIVED + found.encode() + b"\n")
        code = 0
        if stays:
            with suppress(BaseException):
                atexit._run_exitfuncs()
            os.write(write, ENDED + ", ".join(tree.end_what_is_left(write)).encode())
    finally:
        os._exit(code)


def _said(pipe: FileIO, seconds: float) -> bytes | None:
    """What the copy writes until it ends or reports; None if it does neither in time."""
    ready = select.select([pipe], [], [], seconds)[0]
    return pipe.read(4096) if ready else None


def ended(code: int) -> str:
    """How a process ended, from its exit code as `subprocess` gives it."""
    if code >= 0:
        return f"exit code {code}"
    with suppress(ValueError):
        return signal.Signals(-code).name
    return f"signal {-code}"
