"""Modes of torch: what changes the numbers of its functions for all code of the process.

An attack that leaves one on would change the victim, or what enforces the threat model, without touching either.
"""

from __future__ import annotations

import ctypes
import gc
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import overrides
from torch.nn.modules import module as modules
from torch.utils import _python_dispatch as dispatch

from cavbench.isolation.watch import Side, TamperError

HOOKS = (
    modules._global_forward_hooks,
    modules._global_forward_pre_hooks,
    modules._global_backward_hooks,
    modules._global_backward_pre_hooks,
)
ELSEWHERE = ("/Meta", "/CUDA", "/MPS", "/XPU")
"""Ends of the names of operators that compute nothing, or on other devices: torch adds some whenever it imports more."""
STACKS = (
    "a mode of torch's functions",
    "a mode of torch's operations",
    "a transform of functions",
    "a hook of all saved tensors",
    "inference mode",
    "a hook of all modules",
    "an operator of its own",
)
"""What `stacked` counts, as messages call it."""


Stacked = tuple[int, int, int, int, bool, tuple[int, ...], frozenset[str]]


class Modes:
    """The modes of torch as they are now. They are the run's: the victim is asked, and scores are computed, in them."""

    def __init__(self) -> None:
        self._stacked, self._numbers = stacked(), numbers()
        self._theirs = self._numbers

    def check(self, found: Stacked, did: str, *sides: Side) -> None:
        """Raise if more or less is on torch's stacks than at first.

        Args:
            found: what is there.
            did: what was done with it, as "left".
            sides: whose code ran.

        Raises:
            TamperError: if so.
        """
        if found != self._stacked:
            changed = [noun for noun, here, before in zip(STACKS, found, self._stacked, strict=True) if here != before]
            whose = " or the ".join(sides)
            raise TamperError(
                f"the {whose} {did} {' and '.join(changed)}: it changes what torch computes for others", *sides
            )

    def settle(self, *sides: Side) -> None:
        """Put back what code of these sides has changed.

        Raises:
            TamperError: if it left something on torch's stacks.
        """
        self.check(self.put_back(), "left", *sides)

    def put_back(self) -> Stacked:
        """Put back what was changed, without a word, and return what was on torch's stacks."""
        found = stacked()
        if found != self._stacked:
            clear(self._stacked)
        if numbers() != self._numbers:
            put(self._numbers)
        return found

    @contextmanager
    def around(self, *sides: Side) -> Iterator[None]:
        """Run code of these sides: the modes are the run's again after it, and so is whether gradients are computed.

        Raises:
            TamperError: if it left something on torch's stacks.
        """
        differentiates = torch.is_grad_enabled()
        try:
            yield
        except BaseException:
            self.put_back()
            raise
        finally:
            torch.set_grad_enabled(differentiates)
        self.settle(*sides)

    @contextmanager
    def for_victim(self) -> Iterator[None]:
        """Answer in the middle of an attack's code: with the run's numbers. The attack has its own again after that.

        An attack may ask in inference mode, as in `torch.no_grad`: the answer has its gradient all the same.

        Raises:
            TamperError: if something else of the attack is on torch's stacks.
        """
        with torch.inference_mode(False) if torch.is_inference_mode_enabled() else nullcontext():
            self.check(stacked(), "asked under", "attack")
            self._theirs = numbers()
            if self._theirs != self._numbers:
                put(self._numbers)
            try:
                yield
            finally:
                if self._theirs != self._numbers:
                    put(self._theirs)

    @contextmanager
    def for_attack(self) -> Iterator[None]:
        """Run code of the attack in the middle of an answer: with the attack's numbers.

        Raises:
            TamperError: if it leaves something on torch's stacks.
        """
        if self._theirs != self._numbers:
            put(self._theirs)
        try:
            yield
        finally:
            self._theirs = numbers()
            if self._theirs != self._numbers:
                put(self._numbers)
        self.check(stacked(), "left", "attack")


def kept(*sides: Side) -> AbstractContextManager[None]:
    """Run code of these sides; the modes are as before after it (`Modes.around`)."""
    return Modes().around(*sides)


@lru_cache(maxsize=1)
def _replaced(count: int) -> frozenset[str]:
    """The names of torch's operators for the processor that Python code implements; `count` is that of all it implements."""
    return frozenset(name for name in torch.library._impls if name.startswith("aten/") and not name.endswith(ELSEWHERE))


def stacked() -> Stacked:
    """What is on each of torch's stacks: how much, or the names."""
    return (
        torch._C._len_torch_function_stack(),
        torch._C._len_torch_dispatch_stack(),
        torch._C._functorch.maybe_current_level() or 0,
        int(torch._C._autograd._top_saved_tensors_default_hooks(True) is not None),
        torch.is_inference_mode_enabled(),
        tuple(map(len, HOOKS)),
        # A library may implement some when it is imported.
        _replaced(len(torch.library._impls)),
    )


def clear(wanted: Stacked) -> None:
    """Take from torch's stacks what is there beside what `stacked` returned, the latest first."""
    functions, operations, transforms, saved, infers, hooked, replaced = wanted
    while torch._C._len_torch_function_stack() > functions:
        overrides._pop_mode()
    while torch._C._len_torch_dispatch_stack() > operations:
        dispatch._pop_mode()
    while (torch._C._functorch.maybe_current_level() or 0) > transforms:
        torch._C._functorch.pop_dynamic_layer_stack()
    while not saved and torch._C._autograd._top_saved_tensors_default_hooks(True) is not None:
        torch._C._autograd._pop_saved_tensors_default_hooks()
    if torch.is_inference_mode_enabled() and not infers:
        # Only its own context leaves it, which is somebody else's. Another one ends it, as long as that is there: for ever.
        context = torch.inference_mode(False)
        context.__enter__()
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(context))
    for hooks, before in zip(HOOKS, hooked, strict=True):
        while len(hooks) > before:
            hooks.popitem()
    if added := _replaced(len(torch.library._impls)) - replaced:
        for one in gc.get_objects():
            if type(one) is torch.library.Library and not added.isdisjoint(one._op_impls):
                one._destroy()


class Numbers(NamedTuple):
    """The default type, automatic types (whether, and which) on the processor and a GPU, the precision of products, oneDNN."""

    default: torch.dtype
    automatic: bool
    automatic_type: torch.dtype
    automatic_on_gpu: bool
    precision: str
    one_dnn: bool


def numbers() -> Numbers:
    """What changes numbers, as it is now."""
    return Numbers(
        torch.get_default_dtype(),
        torch.is_autocast_enabled("cpu"),
        torch.get_autocast_dtype("cpu"),
        torch.is_autocast_enabled("cuda"),
        torch.get_float32_matmul_precision(),
        bool(torch.backends.mkldnn.enabled),
    )


USUAL = Numbers(torch.float32, False, torch.bfloat16, False, "highest", True)
"""As torch is where nobody has set anything: as workers compute."""


@contextmanager
def usual() -> Iterator[None]:
    """Compute in the caller's process as in a worker, whatever it has set: its own modes are back after it."""
    before = numbers()
    with torch.inference_mode(False):
        put(USUAL)
        try:
            yield
        finally:
            put(before)


def put(wanted: Numbers) -> None:
    """Set what `numbers` returned."""
    torch.set_default_dtype(wanted.default)
    torch.set_autocast_enabled("cpu", wanted.automatic)
    torch.set_autocast_dtype("cpu", wanted.automatic_type)
    torch.set_autocast_enabled("cuda", wanted.automatic_on_gpu)
    torch.set_float32_matmul_precision(wanted.precision)
    torch.backends.mkldnn.enabled = wanted.one_dnn  # type: ignore[assignment]
