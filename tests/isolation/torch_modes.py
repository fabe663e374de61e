"""What changes the numbers of torch for all code of a process, and is still on after the code that switched it on."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from itertools import cycle
from typing import Any, Self

import torch
from torch.autograd.graph import saved_tensors_hooks
from torch.nn.modules.module import register_module_forward_hook
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from cavbench.isolation.modes import stacked


class Functions(TorchFunctionMode):
    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return func(*args, **(kwargs or {}))


class Operations(TorchDispatchMode):
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return func(*args, **(kwargs or {}))


class ModuleHook(AbstractContextManager[None]):
    def __enter__(self) -> None:
        self.handle = register_module_forward_hook(lambda module, given, answer: None)

    def __exit__(self, *about: object) -> None:
        self.handle.remove()


OPERATORS = cycle(("erfinv", "digamma", "i0", "sinc", "special_entr", "special_ndtri", "special_i1", "special_i0e"))
"""Another one each time: torch forgets the name of an operator when the first library that replaced it is collected."""


class Operator(AbstractContextManager[None]):
    def __enter__(self) -> None:
        self.library = torch.library.Library("aten", "IMPL")
        with warnings.catch_warnings(action="ignore"):
            self.library.impl(next(OPERATORS), lambda values: values * 0, "CPU")

    def __exit__(self, *about: object) -> None:
        self.library._destroy()


Mode = Callable[[], AbstractContextManager[Any]]
STACKED: dict[str, Mode] = {
    "a mode of torch's functions": Functions,
    "a mode of torch's operations": Operations,
    "a hook of all saved tensors": lambda: saved_tensors_hooks(lambda x: x, lambda x: x),
    "inference mode": torch.inference_mode,
    "a hook of all modules": ModuleHook,
    "an operator of its own": Operator,
}
NUMBERS: dict[str, Callable[[], object]] = {
    "default": lambda: torch.set_default_dtype(torch.float64),
    "automatic": lambda: torch.set_autocast_enabled("cpu", True),
    "automatic_type": lambda: torch.set_autocast_dtype("cpu", torch.float16),
    "automatic_on_gpu": lambda: torch.set_autocast_enabled("cuda", True),
    "precision": lambda: torch.set_float32_matmul_precision("medium"),
    "one_dnn": lambda: setattr(torch.backends.mkldnn, "enabled", False),
}


def leaving(kind: type[Any], method: str, mode: Left) -> Any:
    """A subclass of a victim that switches a mode on in a method, and leaves it on."""

    def entering(self: Any, *given: Any) -> Any:
        mode.enter()
        return getattr(kind, method)(self, *given)

    return type("Leaves", (kind,), {method: entering})


class Left:
    """A mode that is entered once, and left at the end of a test: `with Left(NAME) as mode: ... mode.enter()`."""

    def __init__(self, name: str) -> None:
        self.mode, self.entered, self.before = STACKED[name](), False, stacked()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *about: object) -> None:
        self.leave()
        assert stacked() == self.before
        # With it, an inference mode puts back whether gradients are computed.
        differentiates = torch.is_grad_enabled()
        del self.mode
        torch.set_grad_enabled(differentiates)

    def enter(self) -> None:
        if not self.entered:
            self.entered = True
            self.mode.__enter__()

    def leave(self) -> None:
        if self.entered and stacked() != self.before:
            self.mode.__exit__(None, None, None)
        self.entered = False


CALLERS: dict[str, Mode] = {
    "inference_mode": torch.inference_mode,
    "no_grad": torch.no_grad,
    "autocast": lambda: torch.autocast("cpu"),
    "default": lambda: changed(torch.set_default_dtype, torch.float64, torch.float32),
    "precision": lambda: changed(torch.set_float32_matmul_precision, "medium", "highest"),
}
"""What a caller's program may have switched on around a call."""


@contextmanager
def changed(write: Callable[[Any], object], value: Any, before: Any) -> Iterator[None]:
    write(value)
    try:
        yield
    finally:
        write(before)
