"""How the engine's functions are compiled: numba, cached on disk where a disk allows it.

Inner functions are compiled into the entry points; only entry points are cached.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit
from numba.core.caching import FunctionCache


def _fingerprint() -> str:
    """Hash of this folder's sources: numba only looks at the file of the cached function, not at what it calls."""
    digest = hashlib.sha256()
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()


FINGERPRINT = _fingerprint()


class _SourcesCache(FunctionCache):
    """numba's cache on disk with this folder's sources in the key; a disk that cannot be written costs time only."""

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        return (*super()._index_key(sig, codegen), FINGERPRINT)

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except OSError:
            return


def inner(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function that only compiled code calls: without wrappers for other callers, in two thirds of the time.

    Called from Python it ends the process; what both call is an `entry_point`.
    """
    return njit(no_cpython_wrapper=True, no_cfunc_wrapper=True)(function)


def entry_point(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function that Python calls: without the GIL, cached in `__pycache__` or the user's cache folder."""
    dispatcher = njit(nogil=True)(function)
    try:
        dispatcher._cache = _SourcesCache(function)
    except RuntimeError:
        # numba found no folder it may write to: the engine compiles in memory, once a process.
        return dispatcher
    return dispatcher
