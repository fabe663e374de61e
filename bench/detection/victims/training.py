"""The training loop of detectors: one optimiser, one learning-rate schedule, and an average of the weights."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from cavbench.core.contracts import Progress
from cavbench.detection.victims.checkpoint import Checkpoint, Stateful

Network = TypeVar("Network", bound=nn.Module)

REPORT_EVERY = 5
"""Updates between two progress reports."""


def descend(
    network: Network,
    loss: Callable[[int], Tensor],
    *,
    updates: int,
    learning_rate: float,
    warm_up: float = 0.05,
    decay: float = 0.998,
    progress: Progress,
    checkpoint: Checkpoint | None = None,
) -> tuple[Network, float]:
    """Train a network with AdamW and a one-cycle learning rate, and return the exponential moving average of its weights.

    Args:
        network: the network, in the mode for training; parameters without gradients do not change.
        loss: returns the loss of an update, given its number from 0.
        updates: number of updates.
        learning_rate: the maximum.
        warm_up: share of the updates in which the learning rate rises; it then falls by a cosine.
        decay: decay of the average of the weights, per update.
        progress: called with the finished share and the loss.
        checkpoint: where the unfinished training is kept; a training that was stopped goes on from there.

    Returns:
        The averaged network, and the CPU time in seconds, without that before a stop.

    Raises:
        FloatingPointError: if the loss is NaN or infinite.
    """
    start = time.process_time()
    mean = AveragedModel(network, multi_avg_fn=_average(decay), use_buffers=True)
    weights = [weight for weight in network.parameters() if weight.requires_grad]
    adam = torch.optim.AdamW(weights, lr=learning_rate, weight_decay=5e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(adam, learning_rate, total_steps=updates, pct_start=warm_up)
    parts: dict[str, Stateful] = {"network": network, "mean": mean, "adam": adam, "schedule": schedule}
    first = checkpoint.resume(parts) if checkpoint else 0
    for update in range(first, updates):
        if checkpoint and update > first:
            checkpoint.keep(update, parts)
        now = loss(update)
        if not math.isfinite(float(now.detach())):
            raise FloatingPointError(f"the loss is {float(now.detach())} after {update} updates")
        adam.zero_grad()
        now.backward()
        torch.nn.utils.clip_grad_norm_(weights, 10.0)
        adam.step()
        schedule.step()
        mean.update_parameters(network)
        if update % REPORT_EVERY == 0:
            progress(update / updates, f"loss {float(now.detach()):.2f}")
    if checkpoint:
        checkpoint.done()
    averaged: Network = mean.module  # type: ignore[assignment]
    return averaged, time.process_time() - start


def _average(decay: float) -> Callable[[Sequence[Tensor], Sequence[Tensor], Tensor | int], None]:
    """The exponential moving average, for all tensors that are not their own average.

    `lerp` of an infinite constant with itself is NaN. A graph pads with such constants, and an attention mask is one.
    """
    moved = get_ema_multi_avg_fn(decay)

    def average(means: Sequence[Tensor], now: Sequence[Tensor], count: Tensor | int) -> None:
        pairs = [pair for pair in zip(means, now, strict=True) if not torch.equal(*pair)]
        if pairs:
            moved(*(list(part) for part in zip(*pairs, strict=True)), count)

    return average
