"""How a detector learns: one optimiser, one schedule, and the running mean of the weights that is kept."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from bench.plugins.contracts import Progress

Network = TypeVar("Network", bound=nn.Module)

REPORT_EVERY = 5
"""Updates between two words about the loss."""


def descend(
    network: Network,
    loss: Callable[[int], Tensor],
    *,
    updates: int,
    learning_rate: float,
    warm_up: float = 0.05,
    decay: float = 0.998,
    progress: Progress,
) -> tuple[Network, float]:
    """Train a network by AdamW, the learning rate rising, then falling by a cosine, and return the mean of its late weights.

    Args:
        network: in the mode it is to be trained in; parameters without gradients stay as they are.
        loss: of an update, by its number from 0.
        updates: how many.
        learning_rate: the highest.
        warm_up: share of the updates in which it rises.
        decay: of the running mean of the weights, an update.
        progress: told how far it is.

    Returns:
        The averaged network, and the seconds of processor time.
    """
    start = time.process_time()
    mean = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(decay), use_buffers=True)
    weights = [weight for weight in network.parameters() if weight.requires_grad]
    adam = torch.optim.AdamW(weights, lr=learning_rate, weight_decay=5e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(adam, learning_rate, total_steps=updates, pct_start=warm_up)
    for update in range(updates):
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
    averaged: Network = mean.module  # type: ignore[assignment]
    return averaged, time.process_time() - start
