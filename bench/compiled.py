"""Compilation of functions with numba, cached on disk if possible.

Inner functions are compiled into the entry points; only entry points are cached.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from numba import njit, types
from numba.core.caching import FunctionCache
from numba.extending import intrinsic
from numba.np.arrayobj import make_array


@cache
def _fingerprint(folder: Path) -> str:
    """Hash of a folder's sources: numba checks only the file of the cached function, not of the functions it calls."""
    digest = hashlib.sha256()
    for source in sorted(folder.glob("*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()


class _SourcesCache(FunctionCache):
    """numba's disk cache with the sources of the function's folder in the key; write errors are ignored."""

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        folder = Path(self._py_func.__code__.co_filename).parent
        return (*super()._index_key(sig, codegen), _fingerprint(folder))

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except OSError:
            return


def inner(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function that is called only from compiled code. No wrappers are built, which saves a third of the time.

    A call from Python crashes the process; use `entry_point` for functions called from Python.
    """
    return njit(no_cpython_wrapper=True, no_cfunc_wrapper=True)(function)


def borrowing(function: Callable[..., Any]) -> Callable[..., Any]:
    """As `inner`, for functions that make no arrays, but only use those of their callers: references are not counted.

    A division by 0 gives inf or nan, as in numpy.
    """
    return njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, error_model="numpy", _nrt=False)(function)


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """As `borrowing`, but compiled into each caller anew, which does not compute what it does not use."""
    return njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, error_model="numpy", _nrt=False, forceinline=True)(
        function
    )


def rounded_once(function: Callable[..., Any]) -> Callable[..., Any]:
    """As `inner`; a product and the sum that it is added to are rounded once, where the processor can. Sums keep their order."""
    return njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, fastmath={"contract"})(function)


@intrinsic
def fused(context: Any, first: Any, second: Any, third: Any) -> Any:
    """In compiled code: `first` * `second` + `third`, rounded once."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fma(*arguments)

    return types.float64(types.float64, types.float64, types.float64), build


@intrinsic
def uncounted(context: Any, array: Any) -> Any:
    """In compiled code: a view of an array without a reference count, because counting costs more than a short function does.

    The caller keeps the array alive.
    """

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        view = make_array(signature.return_type)(context, builder, arguments[0])
        view.meminfo = view.meminfo.type(None)
        return view._getvalue()

    return array(array), build


def entry_point(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function that is called from Python: it releases the GIL and is cached in `__pycache__` or the user's cache."""
    dispatcher = njit(nogil=True)(function)
    try:
        dispatcher._cache = _SourcesCache(function)
    except RuntimeError:
        # numba found no writable folder: the function is compiled in memory, once per process.
        return dispatcher
    return dispatcher
