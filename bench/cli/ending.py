"""The end of a command: nothing that a plug-in left holds or outlives it, and a line says whose it was."""

from __future__ import annotations

import atexit
import os
import sys
import threading
from _thread import start_new_thread
from collections.abc import Callable
from contextlib import suppress

# By name, before any plug-in is imported: one could replace or delete what a module has.
from faulthandler import dump_traceback_later
from os import _exit as end_now
from os import open as open_descriptor
from os import write
from time import sleep

from cavbench.errors import bounded
from cavbench.isolation import tree

END_S = 6.0
"""Seconds that threads and hooks may take after the command has said all."""
BACKSTOP_S = 2.0
"""Seconds after that until the process is ended even if no line of Python can run."""


def ended(command: Callable[[], None]) -> None:
    """Carry out a command, and end the process with its exit code.

    A process that imported a plug-in waits for threads and hooks of its end `END_S` seconds, and ends the processes that are left
    then. Objects that are left are not deleted one by one: their code could hang, too, and those of torch take a second.
    """
    code: object = 0
    tree.adopt()
    try:
        command()
    except SystemExit as error:
        code = error.code
    except BaseException:
        sys.excepthook(*sys.exc_info())
        code = 1
    # Most commands import no plug-in, some not even what finds them.
    foreign = "cavbench.core.registry" in sys.modules and bool(_foreign())
    if not foreign and "torch" not in sys.modules:
        raise SystemExit(code)
    if isinstance(code, str):
        sys.stderr.write(f"{code}\n")
    number = code if isinstance(code, int) else int(code is not None)
    _flush()
    _end(number, watched=foreign)


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        # What reads them may be gone.
        with suppress(Exception):
            stream.flush()


def _end(code: int, *, watched: bool) -> None:
    """Wait for threads and hooks as Python does, but not for ever if it is `watched`."""
    phase = ["threads"]
    with suppress(BaseException):
        if watched:
            dump_traceback_later(END_S + BACKSTOP_S, exit=True, file=open_descriptor(os.devnull, os.O_WRONLY))
    with suppress(BaseException):
        if watched:
            # `threading.Thread.start` would wait for ever where a plug-in took away what a new thread calls first.
            start_new_thread(_watch, (code, phase))
        threading._shutdown()  # type: ignore[attr-defined]
        phase[0] = "hooks"
        atexit._run_exitfuncs()
        _flush()
    phase[0] = "processes"
    with suppress(BaseException):
        if watched and (names := tree.end_what_is_left()):
            whose = ", ".join(sorted(set(_foreign().values())))
            line = f"the command ended processes that one of {whose} left: {', '.join(names)}"
            write(2, f"warning: {bounded(line)}\n".encode())
    with suppress(BaseException):
        # Adopted processes that have ended are gone before the command is.
        while watched and os.waitpid(-1, os.WNOHANG)[0]:
            pass
    end_now(code)


def _watch(code: int, phase: list[str]) -> None:
    sleep(END_S)
    if phase[0] == "processes":
        return
    line = "the command is ended, although something that a plug-in left does not end"
    with suppress(BaseException):
        line = f"the command is ended, although {_held(phase[0])}"
    with suppress(BaseException):
        write(2, f"warning: {bounded(line)}\n".encode())
    with suppress(BaseException):
        tree.end_what_is_left()
    end_now(code)


def _held(phase: str) -> str:
    """What holds the end, and whose it is."""
    from cavbench.isolation.threads import left, owner

    held = left() if phase == "threads" else [threading.main_thread()]
    what = f"the thread {held[0].name!r}" if len(held) == 1 else f"{len(held)} threads"
    if phase == "hooks":
        what = "a hook for the end of the process"
    packages = _foreign()
    owners = dict.fromkeys(whose for one in held if (whose := owner(one, packages)))
    who = " and ".join(owners) if owners else f"one of {', '.join(sorted(set(packages.values())))}"
    return f"{what} of {who} {'do' if len(held) > 1 else 'does'} not end"


def _foreign() -> dict[str, str]:
    from cavbench.core.registry import foreign

    return foreign()
