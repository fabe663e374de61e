#!/usr/bin/env bash
# One guesses: the average of the weights leaves a constant buffer as it is, an infinite one too: a mask, or the padding of a maximum pool.
# What happens: AveragedModel(use_buffers=True) with get_ema_multi_avg_fn makes it NaN at the second update, and so does the plain average. The
# same moving average by get_ema_avg_fn keeps it. A network that has no infinite weight then answers NaN, and its training loss never showed it.
# Versions: torch 2.13.0. Source: a detector whose graph pads with minus infinity, after adversarial training.
source "$(dirname "$0")/fresh.sh"
fresh torch==2.13.0 numpy
see <<'P'
import torch
from torch import nn
from torch.optim import swa_utils

AVERAGES = {
    "get_ema_multi_avg_fn": {"multi_avg_fn": swa_utils.get_ema_multi_avg_fn(0.9)},
    "get_swa_multi_avg_fn": {"multi_avg_fn": swa_utils.get_swa_multi_avg_fn()},
    "get_ema_avg_fn": {"avg_fn": swa_utils.get_ema_avg_fn(0.9)},
}


class Padded(nn.Module):
    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(1))
        self.register_buffer("padding", torch.tensor(float("-inf")))


def averaged(words):
    network = Padded()
    mean = swa_utils.AveragedModel(network, use_buffers=True, **words)
    for _ in range(3):
        mean.update_parameters(network)
    return str(float(mean.module.padding))


seen = {name: averaged(words) for name, words in AVERAGES.items()}
print(f"torch {torch.__version__}: averages of a buffer that is always -inf {seen}")
raise SystemExit(list(seen.values()) != ["nan", "nan", "-inf"])
P
