"""The training loop of detectors: the average of the weights."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from cavbench.detection.victims.training import descend

DECAY = 0.9


class Padded(nn.Module):
    """A line, with constants as a graph has them: an infinite one, a mask, and a count."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.tensor([1.0, -2.0]))
        self.register_buffer("padding", torch.tensor(float("-inf")))
        self.register_buffer("mask", torch.tensor([0.0, float("-inf")]))
        self.register_buffer("count", torch.tensor(3))
        self.register_buffer("seen", torch.zeros(2))


def test_constants_are_their_own_average() -> None:
    network, before = Padded(), [torch.tensor([1.0, -2.0])]

    def loss(update: int) -> Tensor:
        if update:
            before.append(network.weight.detach().clone())
        network.seen += 1
        return (network.weight**2).sum()

    averaged, _ = descend(network, loss, updates=5, learning_rate=0.1, decay=DECAY, progress=lambda share, text: None)
    before.append(network.weight.detach())
    wanted, seen = before[1], torch.ones(2)
    for update in range(2, 6):
        wanted = DECAY * wanted + (1 - DECAY) * before[update]
        seen = DECAY * seen + (1 - DECAY) * update
    torch.testing.assert_close(averaged.weight.detach(), wanted)
    torch.testing.assert_close(averaged.seen, seen)
    for name in ("padding", "mask", "count"):
        assert torch.equal(getattr(averaged, name), getattr(network, name)), name
