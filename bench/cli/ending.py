"""The end of a command: no thread and no hook that a plug-in left holds it, and a line says whose it was."""

from __future__ import annotations

import atexit
import faulthandler
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from types import FrameType

from bench.errors import bounded

END_S = 6.0
"""Seconds that threads and hooks may take after the command has said all."""
BACKSTOP_S = 2.0
"""Seconds after that until the process is ended even if no line of Python can run."""


def ended(command: Callable[[], None]) -> None:
    """Carry out a command, and end the process with its exit code.

    A process that imported a plug-in waits for threads and hooks of its end `END_S` seconds. Objects that are left are not
    deleted one by one: their code could hang, too.
    """
    code: object = 0
    try:
        command()
    except SystemExit as error:
        code = error.code
    except BaseException:
        sys.excepthook(*sys.exc_info())
        code = 1
    # Most commands import no plug-in, some not even what finds them.
    if "bench.plugins.registry" not in sys.modules or not _foreign():
        raise SystemExit(code)
    if isinstance(code, str):
        sys.stderr.write(f"{code}\n")
    number = code if isinstance(code, int) else int(code is not None)
    _flush()
    _end(number)


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        # What reads them may be gone.
        with suppress(Exception):
            stream.flush()


def _end(code: int) -> None:
    """Wait for threads and hooks as Python does, but not for ever."""
    phase = ["threads"]
    threading.Thread(target=_watch, args=(code, phase), daemon=True).start()
    with open(os.devnull, "w") as silence, suppress(BaseException):
        faulthandler.dump_traceback_later(END_S + BACKSTOP_S, exit=True, file=silence)
        threading._shutdown()  # type: ignore[attr-defined]
        phase[0] = "hooks"
        atexit._run_exitfuncs()
        _flush()
    os._exit(code)


def _watch(code: int, phase: list[str]) -> None:
    time.sleep(END_S)
    line = "the command is ended, although something that a plug-in left does not end"
    with suppress(BaseException):
        line = f"the command is ended, although {_held(phase[0])}"
    with suppress(BaseException):
        os.write(2, f"warning: {bounded(line)}\n".encode())
    os._exit(code)


def _held(phase: str) -> str:
    """What holds the end, and whose it is."""
    frames = sys._current_frames()
    main = threading.main_thread()
    if phase == "threads":
        held = [one for one in threading.enumerate() if not one.daemon and one is not main]
        what = f"the thread {held[0].name!r}" if len(held) == 1 else f"{len(held)} threads"
        owners = [_owner(frames.get(one.ident or 0), getattr(one, "_target", None)) for one in held]
        owners = list(dict.fromkeys(filter(None, owners)))
    else:
        what = "a hook for the end of the process"
        owners = list(filter(None, [_owner(frames.get(main.ident or 0), None)]))
    who = " and ".join(owners) if owners else f"one of {', '.join(sorted(set(_foreign().values())))}"
    return f"{what} of {who} does not end"


def _owner(frame: FrameType | None, target: object) -> str:
    """The package whose code a thread runs; empty if it is none of a plug-in."""
    packages = _foreign()
    modules = [str(getattr(target, "__module__", "")), *_modules(frame)]
    return next((packages[top] for module in modules if (top := module.partition(".")[0]) in packages), "")


def _foreign() -> dict[str, str]:
    from bench.plugins.registry import foreign

    return foreign()


def _modules(frame: FrameType | None) -> Iterator[str]:
    while frame is not None:
        yield str(frame.f_globals.get("__name__", ""))
        frame = frame.f_back
