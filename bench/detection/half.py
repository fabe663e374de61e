"""Passes of a detector in bfloat16: what crafts a patch twice as fast, and is not what scores it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.overrides import TorchFunctionMode

from cavbench.detection.detector import Predictions

Precision = Literal["float32", "bfloat16"]
NAMES = ("sigmoid", "softmax", "log_softmax", "logsigmoid", "softplus", "exp", "log")
FULL = {
    getattr(owner, name)
    for owner in (torch, Tensor, torch.special, functional)
    for name in NAMES
    if hasattr(owner, name)
}
"""Functions that make probabilities and sizes. With 8 bits a probability above 0.998 is 1, and its gradient 0."""


class _Full(TorchFunctionMode):
    """Computes `FULL` in float32."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func in FULL:
            args = [one.float() if isinstance(one, Tensor) and one.dtype is torch.bfloat16 else one for one in args]
        return func(*args, **(kwargs or {}))


@contextmanager
def computing_in(precision: Precision, network: nn.Module) -> Iterator[None]:
    """Run a network with its convolutions and products of matrices in a precision, and what follows them in float32."""
    with ExitStack() as stack:
        if precision == "bfloat16":
            device = next((one.device.type for one in network.parameters()), "cpu")
            stack.enter_context(torch.autocast(device, torch.bfloat16))
            stack.enter_context(_Full())
        yield


def in_full(predictions: Predictions) -> Predictions:
    """Predictions in float32."""
    return Predictions(predictions.boxes.float(), predictions.objectness.float(), predictions.classes.float())
