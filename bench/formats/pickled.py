"""Reads a pickle as data. A pickle is a program for a small machine; here nothing that it names is imported or called.

What it would call is an object `Made` with the name and the arguments. So a saved object is read by its names and numbers, and
a crafted one is a tree with strange names.
"""

from __future__ import annotations

import base64
import pickletools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

TYPES = {"f4": "<f4", "f8": "<f8", "u1": "u1"}
"""Types of the arrays that are read, by their names in a pickle."""
MOST = 2**20
"""Operations that a pickle may have."""
KEYS = (str, bytes, int, float, type(None))
"""Types of the keys of a dict."""
ERRORS = (ValueError, IndexError, KeyError, TypeError, AttributeError, EOFError, OverflowError, MemoryError)
"""What reading a damaged pickle raises."""


@dataclass(frozen=True)
class Named:
    """A class or a function that a pickle names."""

    name: str


@dataclass
class Made:
    """What a pickle would make by calling something.

    Args:
        name: what it would call.
        args: with these arguments.
        state: what it would put into the result; None for nothing.
    """

    name: str
    args: tuple[Any, ...]
    state: Any = None


@dataclass
class _Machine:
    stack: list[Any] = field(default_factory=list)
    marks: list[int] = field(default_factory=list)
    memo: dict[int, Any] = field(default_factory=dict)

    def pop(self, count: int) -> list[Any]:
        if count > len(self.stack) - (self.marks[-1] if self.marks else 0):
            raise ValueError("an operation without its arguments")
        found = self.stack[len(self.stack) - count :]
        del self.stack[len(self.stack) - count :]
        return found

    def marked(self) -> list[Any]:
        """All since the last mark."""
        found = self.stack[self.marks[-1] :]
        del self.stack[self.marks.pop() :]
        return found

    def call(self, function: Any, args: Any, named: Any = None) -> None:
        if not isinstance(function, Named) or not isinstance(args, tuple):
            raise ValueError("a call of something else than a name")
        self.stack.append(Made(function.name, (*args, named) if named else args))


def read(content: bytes) -> Any:
    """What a pickle holds: numbers, texts, lists, tuples, dicts, sets, names, and `Made`.

    Raises:
        ValueError: if it is damaged, or has operations that are not read.
    """
    machine = _Machine()
    try:
        for number, (operation, argument, _) in enumerate(pickletools.genops(content)):
            if number > MOST:
                raise ValueError("too many operations")
            if operation.name == "STOP":
                (found,) = machine.stack
                return found
            OPERATIONS[operation.name](machine, argument)
    except ERRORS as error:
        raise ValueError(f"it is not a pickle that is read as data ({type(error).__name__})") from error
    raise ValueError("it has no end")


def array(made: Any) -> NDArray[Any] | None:
    """The numpy array that a pickle would make; None if it is none, or of other numbers than float32, float64 and uint8."""
    try:
        match made:
            # pickle 4 and 5
            case Made(name=name, state=(_, tuple(shape), dtype, bool(fortran), bytes(content))) if _is(
                name, "_reconstruct"
            ):
                order = "F" if fortran else "C"
            case Made(name=name, args=(bytes() | bytearray() as content, dtype, tuple(shape), str(order))) if _is(
                name, "_frombuffer"
            ):
                pass
            case _:
                return None
        kind = TYPES[_text(dtype.args[0])]
        return np.frombuffer(bytes(content), kind).reshape(shape, order=order)  # type: ignore[call-overload]
    except ERRORS:
        return None


def floats(pickled: str, size: int) -> NDArray[np.float32] | None:
    """The numbers of a pickled array, which are float32, float64 or uint8: [n, size].

    Args:
        pickled: the pickle, in base64.
        size: numbers in a row of the array, at least 1.

    Returns:
        None if it is no such array.
    """
    try:
        found = array(read(base64.b64decode(pickled, validate=True)))
    # `binascii.Error` is a ValueError, too.
    except (ValueError, RecursionError):
        return None
    return (
        found.astype(np.float32).reshape(-1, size)
        if found is not None and found.size % size == 0 and found.size
        else None
    )


def _text(value: Any) -> str:
    """A name. Of a list that holds itself many times over neither the text nor the hash has an end."""
    if not isinstance(value, str):
        raise TypeError("a name that is no text")
    return value


def _is(name: str, function: str) -> bool:
    """Whether a name is a function of numpy, in whichever of its modules."""
    return name.startswith("numpy.") and name.endswith(f".{function}")


def _push(machine: _Machine, argument: Any) -> None:
    machine.stack.append(argument)


def _constant(value: Any) -> Callable[[_Machine, Any], None]:
    return lambda machine, argument: machine.stack.append(value)


def _fresh(kind: type) -> Callable[[_Machine, Any], None]:
    return lambda machine, argument: machine.stack.append(kind())


def _tuple(count: int) -> Callable[[_Machine, Any], None]:
    return lambda machine, argument: machine.stack.append(tuple(machine.pop(count)))


def _memoize(machine: _Machine, argument: Any) -> None:
    machine.memo[len(machine.memo) if argument is None else argument] = machine.stack[-1]


def _drop(machine: _Machine, argument: Any) -> None:
    machine.pop(1)


def _append(machine: _Machine, items: list[Any]) -> None:
    machine.stack[-1].extend(items)


def _set(machine: _Machine, items: list[Any]) -> None:
    # As in `_text`: the hash of a tuple of tuples has no end.
    if not all(isinstance(key, KEYS) for key in items[::2]):
        raise ValueError("a key that is neither a text nor a number")
    pairs = dict(zip(items[::2], items[1::2], strict=True))
    target = machine.stack[-1]
    # An OrderedDict, for instance, is filled like a dict.
    if isinstance(target, Made):
        target.args = (*target.args, pairs)
    else:
        target.update(pairs)


def _build(machine: _Machine, argument: Any) -> None:
    (state,) = machine.pop(1)
    machine.stack[-1].state = state


def _global(machine: _Machine, argument: str) -> None:
    machine.stack.append(Named(argument.replace(" ", ".", 1)))


def _stack_global(machine: _Machine, argument: Any) -> None:
    module, name = machine.pop(2)
    machine.stack.append(Named(f"{_text(module)}.{_text(name)}"))


OPERATIONS: dict[str, Callable[[_Machine, Any], None]] = {
    **dict.fromkeys(("PROTO", "FRAME"), lambda machine, argument: None),
    **dict.fromkeys(("INT", "LONG", "LONG1", "LONG4", "BININT", "BININT1", "BININT2", "FLOAT", "BINFLOAT"), _push),
    **dict.fromkeys(("BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8"), _push),
    "BYTEARRAY8": _push,
    "NONE": _constant(None),
    "NEWTRUE": _constant(True),
    "NEWFALSE": _constant(False),
    "EMPTY_LIST": _fresh(list),
    "EMPTY_DICT": _fresh(dict),
    "EMPTY_SET": _fresh(set),
    "EMPTY_TUPLE": _constant(()),
    "TUPLE1": _tuple(1),
    "TUPLE2": _tuple(2),
    "TUPLE3": _tuple(3),
    "MARK": lambda machine, argument: machine.marks.append(len(machine.stack)),
    "TUPLE": lambda machine, argument: machine.stack.append(tuple(machine.marked())),
    "APPEND": lambda machine, argument: _append(machine, machine.pop(1)),
    "APPENDS": lambda machine, argument: _append(machine, machine.marked()),
    "SETITEM": lambda machine, argument: _set(machine, machine.pop(2)),
    "SETITEMS": lambda machine, argument: _set(machine, machine.marked()),
    "MEMOIZE": _memoize,
    "BINPUT": _memoize,
    "LONG_BINPUT": _memoize,
    "BINGET": lambda machine, argument: machine.stack.append(machine.memo[argument]),
    "LONG_BINGET": lambda machine, argument: machine.stack.append(machine.memo[argument]),
    "GLOBAL": _global,
    "STACK_GLOBAL": _stack_global,
    "REDUCE": lambda machine, argument: machine.call(*machine.pop(2)),
    "NEWOBJ": lambda machine, argument: machine.call(*machine.pop(2)),
    "NEWOBJ_EX": lambda machine, argument: machine.call(*machine.pop(3)),
    "BUILD": _build,
    "POP": _drop,
}  # fmt: skip
"""What each operation does to the stack. Persistent objects, extension codes and buffers outside are not among them."""
