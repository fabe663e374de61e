"""Whose a thread is: the package of the plug-in whose code it runs."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator, Mapping
from types import FrameType


def left() -> list[threading.Thread]:
    """The threads that hold the end of the process."""
    return [one for one in threading.enumerate() if not one.daemon and one is not threading.main_thread()]


def owner(thread: threading.Thread, packages: Mapping[str, str]) -> str:
    """The package whose code a thread runs, with its version; empty if it is none of a plug-in.

    Args:
        thread: the thread.
        packages: those of plug-ins, with their versions, by their top-level modules.
    """
    frame = sys._current_frames().get(thread.ident or 0)
    modules = [str(getattr(getattr(thread, "_target", None), "__module__", "")), *_modules(frame)]
    return next((packages[top] for module in modules if (top := module.partition(".")[0]) in packages), "")


def holders(packages: Mapping[str, str]) -> list[str]:
    """What threads of plug-ins run beside the main one: \"the thread 'filler' of PACKAGE VERSION\"."""
    others = [one for one in threading.enumerate() if one is not threading.main_thread()]
    return [f"the thread {one.name!r} of {whose}" for one in others if (whose := owner(one, packages))]


def _modules(frame: FrameType | None) -> Iterator[str]:
    while frame is not None:
        yield str(frame.f_globals.get("__name__", ""))
        frame = frame.f_back
