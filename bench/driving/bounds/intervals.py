"""Interval bounds of a Q-network with a gradient in its weights, to train with."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from cavbench.driving.bounds.fronts import affine, of_cars, pooled
from cavbench.driving.victims.networks import QNetwork


def leads(network: QNetwork, low: Tensor, high: Tensor) -> Tensor:
    """Lower bounds [N, A, A] of Q_i - Q_j over each box, by intervals (IBP, Gowal et al. 2018, arXiv 1810.12715).

    They are those of `BoundedNetwork.leads`, in the precision of the network and differentiable. The difference of two actions
    is bounded in the last layer at once, which is tighter than the difference of their bounds.

    Args:
        network: the network.
        low, high: the boxes [N, V, F]; presence must be the same in both.
    """
    ego, cars, presence = (low[:, 0, 1:], high[:, 0, 1:]), (low[:, 1:], high[:, 1:]), low[:, 1:, :1]
    _, responses = of_cars(network.encoder, ego, cars)
    box = pooled(ego, (responses[0] * presence, responses[1] * presence))
    *hidden, last = (layer for layer in network.head if isinstance(layer, nn.Linear))
    for layer in hidden:
        below, above = affine(layer.weight, layer.bias, box)
        box = below.relu(), above.relu()
    # The first output is the state's value, the same for all actions.
    weight, bias = last.weight[1:], last.bias[1:]
    actions = len(bias)
    pairs = torch.eye(actions).to(weight)
    pairs = (pairs[:, None] - pairs[None, :]).flatten(0, 1)
    return affine(pairs @ weight, pairs @ bias, box)[0].unflatten(1, (actions, actions))
