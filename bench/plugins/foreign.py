"""Runs foreign code that must not end this process: what it raises, and what it does when it is imported."""

from __future__ import annotations

import importlib
import os
import select
import signal
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from bench.errors import EscapeError, reason
from bench.plugins.framework import Snapshot

IMPORT_S = 120
"""Seconds that the import of a module may take."""
SURVIVED = b"survived"


class StopUnitError(BaseException):
    """The run itself stops foreign code by this exception; no foreign code should catch it."""


@contextmanager
def contained() -> Iterator[None]:
    """Run foreign code that must not end this process by an exception.

    The user's Ctrl-C goes through, even if the foreign code catches it.

    Raises:
        EscapeError: for a SystemExit, a GeneratorExit, a KeyboardInterrupt that is not the user's, and any other exception that
            is no `Exception`.
    """
    pressed = False

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
        if listens:
            signal.signal(signal.SIGINT, before)
    if pressed:
        raise KeyboardInterrupt


def harm(module: str, seconds: float = IMPORT_S) -> str:
    """Import a module in a copy of this process, and say what that does to the copy; empty if it does no harm.

    Exceptions are no harm: the import in this process reports them.

    Args:
        module: name of the module.
        seconds: how long it may take.

    Returns:
        That the module ends the process, never finishes, or replaces functions of the framework; empty without `os.fork`.
    """
    if sys.platform != "linux":
        return ""
    read, write = os.pipe()
    with warnings.catch_warnings():
        # Python warns of threads in the parent; the child only imports a module and ends.
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if not child:
        _import_and_end(module, write)
    os.close(write)
    said = _said(read, seconds)
    if said is None:
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    if said is None:
        return f"its import does not end within {seconds:g} s"
    if not said.startswith(SURVIVED):
        code = os.waitstatus_to_exitcode(status)
        return f"its import ends the process ({ended(code)})"
    changed = said.removeprefix(SURVIVED).decode(errors="replace")
    return f"its import replaces {changed}" if changed else ""


def _import_and_end(module: str, write: int) -> None:
    """In the copy: import the module without a word on the terminal, report, and end."""
    try:
        os.setsid()
        silence = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(silence, stream)
        if "torch" in sys.modules:
            # The threads of the parent are not in the copy: waiting for them would never end.
            sys.modules["torch"].set_num_threads(1)
        framework = Snapshot()
        with suppress(BaseException):
            importlib.import_module(module)
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
