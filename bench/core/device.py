"""The device that victims compute on: the processor, or a GPU. Worlds, attacks and measurements stay on the processor.

Importing it is quick: torch is imported where it is needed.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from cavbench.core.registry import unknown

if TYPE_CHECKING:
    import torch
    from torch import nn

DEVICES = ("auto", "cpu", "cuda")
CPU = "cpu"
VICTIM_ON = "; victim on "
"""What separates the device in the column `machine` of records."""


def resolved(asked: str, executor: str) -> str:
    """`cpu` or `cuda`, for the option `device`.

    Args:
        asked: `auto` for a GPU if there is one, `cpu` or `cuda`.
        executor: name of the back end; Ray gives its workers no GPU.

    Raises:
        ValueError: if there is no such device.
    """
    if asked not in DEVICES:
        raise ValueError(unknown(f"device {asked!r}", asked, DEVICES))
    if asked == "cuda" and executor == "ray":
        raise ValueError("executor=ray gives its workers no GPU: leave out device=cuda, or use executor=processes")
    if asked == "cuda" and not _gpu():
        raise ValueError(
            "device=cuda needs a GPU that torch can use, and there is none: leave it out, or use device=auto"
        )
    return "cuda" if asked != CPU and executor != "ray" and _gpu() else CPU


def _gpu() -> bool:
    import torch

    return torch.cuda.is_available()


def move(network: nn.Module, device: torch.device) -> None:
    """Move the parameters, the buffers and tensors that are plain attributes of a network to a device.

    On a GPU, convolutions compute in full single precision, and the same in each run.
    """
    import torch

    if device.type == "cuda":
        torch.backends.cudnn.allow_tf32 = False
        torch.backends.cudnn.deterministic = True
    network.to(device)
    for module in network.modules():
        for name, value in list(vars(module).items()):
            if isinstance(value, torch.Tensor):
                setattr(module, name, value.to(device))


def said(device: str) -> str:
    """What the column `machine` of records says of a device; nothing of the processor."""
    if device != "cuda":
        return "" if device == CPU else f"{VICTIM_ON}{device}"
    import torch

    return f"{VICTIM_ON}{device}: {torch.cuda.get_device_name()}, CUDA {torch.version.cuda}"


def recorded(machine: str) -> str:
    """The device that the column `machine` of a record names, if it is here; otherwise the processor."""
    return "cuda" if stated(machine) == "cuda" and _gpu() else CPU


def stated(machine: str) -> str:
    """The device that the column `machine` of a record names, whether it is here or not."""
    named = re.search(rf"{VICTIM_ON}(\w+)", machine)
    return named[1] if named else CPU
