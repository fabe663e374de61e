"""Runs foreign code that must not end this process: what it raises, and what it does when it is imported."""

from __future__ import annotations

import faulthandler
import os
import select
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from bench.errors import EscapeError, reason
from bench.plugins.framework import Snapshot

HARM_S = 120
"""Seconds that the import of a module, or reading a file, may take."""
SURVIVED = b"survived"


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


def harm(act: Callable[[], object], seconds: float = HARM_S) -> str:
    """Do something in a copy of this process, and say what that does to the copy; empty if it does no harm.

    Exceptions are no harm: the same act in this process reports them.

    Args:
        act: imports a module, or reads a file.
        seconds: how long it may take.

    Returns:
        That it ends the process, does not end, or replaces functions of the framework; empty without `os.fork`.
    """
    if sys.platform != "linux":
        return ""
    read, write = os.pipe()
    with warnings.catch_warnings():
        # Python warns of threads in the parent; the child does this one thing and ends.
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if not child:
        _act_and_end(act, write)
    os.close(write)
    said = _said(read, seconds)
    # What it started ends, too.
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(child, signal.SIGKILL)
    if said is None:
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    if said is None:
        return f"does not end within {seconds:g} s"
    if not said.startswith(SURVIVED):
        code = os.waitstatus_to_exitcode(status)
        return f"ends the process ({ended(code)})"
    changed = said.removeprefix(SURVIVED).decode(errors="replace")
    return f"replaces {changed}" if changed else ""


def _act_and_end(act: Callable[[], object], write: int) -> None:
    """In the copy: do it without a word on the terminal, report, and end."""
    try:
        os.setsid()
        silence = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(silence, stream)
        if "torch" in sys.modules:
            # The threads of the parent are not in the copy: waiting for them would never end.
            sys.modules["torch"].set_num_threads(1)
        # A crash is reported in our own words.
        faulthandler.disable()
        framework = Snapshot()
        with suppress(BaseException):
            act()
        os.write(write, SURVIVED + framework.changed().encode())
    finally:
        os._exit(0)


def _said(read: int, seconds: float) -> bytes | None:
    """What the copy writes until it ends or reports; None if it does neither in time."""
    with os.fdopen(read, "rb", buffering=0) as pipe:
        ready = select.select([pipe], [], [], seconds)[0]
        return pipe.read(4096) if ready else None


def ended(code: int) -> str:
    """How a process ended, from its exit code as `subprocess` gives it."""
    if code >= 0:
        return f"exit code {code}"
    with suppress(ValueError):
        return signal.Signals(-code).name
    return f"signal {-code}"
