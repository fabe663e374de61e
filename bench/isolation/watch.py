"""A watch on a network: who evaluates it outside of the oracle, and whether it is still what was loaded."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from typing import Any, Literal

from torch import Tensor, nn

from cavbench.errors import UserError

Side = Literal["attack", "defense"]
HOOKS = (
    "_forward_hooks",
    "_forward_pre_hooks",
    "_backward_hooks",
    "_backward_pre_hooks",
    "_state_dict_hooks",
    "_load_state_dict_pre_hooks",
)
METHODS = ("__call__", "forward", "scores", "predict", "initial", "advance", "aggregate")
HOOK = -1
"""Key of the watch's own hook; torch counts its keys up from 0."""


class TamperError(UserError):
    """Foreign code did what it may not do; the records of the unit are not written.

    Args:
        message: what it did, in one line.
        sides: who can have done it; the run adds the packages that ship them.
    """

    def __init__(self, message: str, *sides: Side) -> None:
        super().__init__(message)
        self.sides = sides


class Watch:
    """Watches a network for the time of a unit: `with Watch(network, "victim") as watch: ...`.

    A forward pass of a module with weights while foreign code runs (`away`), other than through the oracle, is counted in
    `strays`. The hooks that count are on the modules only while foreign code runs, because they make every forward pass
    slower. Tensors are compared by their version counters at any time (`touched`), and by their contents at the end.

    Args:
        network: the (defended) victim.
        noun: what messages call it.
        sides: who can have changed it.
        listens: whether to count forward passes; without foreign code there are none to count.

    Raises:
        TamperError: at the end, if weights, hooks, mode or methods of the network have changed.
    """

    def __init__(self, network: nn.Module, noun: str, *sides: Side, listens: bool = True) -> None:
        self.network, self.noun, self.sides = network, noun, sides or ("attack", "defense")
        self.strays = 0
        self._away = self._removed = False
        self._tensors = [value for _, value in _tensors(network) if not value.is_inference()]
        self._version = self._versions()
        # Only modules that compute with weights of their own, and the network itself, have a hook.
        own = [one for one in network.modules() if one is network or any(True for _ in _own(one))]
        self._heard = own if listens else []

    def __enter__(self) -> Watch:
        self._before = marks(self.network)
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        self.away = False
        if error is not None:
            return
        after = marks(self.network)
        changed = [name for name, mark in self._before.items() if after[name] != mark]
        if self._removed and "hooks" not in changed:
            changed.append("hooks")
        if changed:
            raise TamperError(f"the {' and '.join(changed)} of the {self.noun} changed during the run", *self.sides)

    @property
    def away(self) -> bool:
        """Whether foreign code runs."""
        return self._away

    @away.setter
    def away(self, away: bool) -> None:
        if away == self._away:
            return
        self._away = away
        # `register_forward_pre_hook` and `remove` do the same, and take as long as the forward pass of a small network.
        for module in self._heard:
            if away:
                module._forward_pre_hooks[HOOK] = self._called
            elif module._forward_pre_hooks.pop(HOOK, None) is None:
                self._removed = True

    def _called(self, module: nn.Module, inputs: object) -> None:
        self.strays += 1

    def touched(self) -> bool:
        """Whether a weight was written to since the last call."""
        before, self._version = self._version, self._versions()
        return self._version != before

    def _versions(self) -> int:
        return sum([tensor._version for tensor in self._tensors])


def marks(network: nn.Module) -> Mapping[str, str]:
    """Hashes of the weights (parameters, buffers and tensors kept as attributes), hooks, mode and methods of a network."""
    weights, hooks, mode, methods = hashlib.sha256(), [], [], []
    for name, value in _tensors(network):
        weights.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
        weights.update(value.detach().cpu().contiguous().numpy().tobytes())
    for name, module in network.named_modules():
        hooks += [(name, kind, len(getattr(module, kind, ()))) for kind in HOOKS]
        mode += [(name, module.training)]
        # What an object computes with, if it says so, is part of its method.
        own = [
            (key, id(value), [id(getattr(value, name)) for name in getattr(type(value), "marked", ())])
            for key, value in vars(module).items()
            if callable(value) and not isinstance(value, nn.Module)
        ]
        inherited = [id(getattr(type(module), method, None)) for method in METHODS]
        methods += [(name, id(type(module)), own, inherited)]
    return {"weights": weights.hexdigest(), "hooks": repr(hooks), "mode": repr(mode), "methods": repr(methods)}


def _own(module: nn.Module) -> Iterator[Tensor]:
    yield from module.parameters(recurse=False)
    yield from module.buffers(recurse=False)


def _tensors(network: nn.Module) -> Iterator[tuple[str, Tensor]]:
    """Parameters, buffers (those that are not saved, too) and tensors that are plain attributes."""
    yield from network.named_parameters()
    yield from network.named_buffers()
    for name, module in network.named_modules():
        attributes: dict[str, Any] = vars(module)
        yield from ((f"{name}.{key}", value) for key, value in attributes.items() if isinstance(value, Tensor))
