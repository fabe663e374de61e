"""What the checks of the driving track stand on: observations, and victims with random weights."""

from __future__ import annotations

import torch
from torch import Tensor

from bench.driving import ActionType, Features, Policy

ACTIONS, HIDDEN = 5, 16


def observations(count: int, *, features: Features, rows: int = 10, seed: int = 0) -> Tensor:
    """Random observations [count, rows, F] of which some rows are absent; the ego's never is."""
    generator = torch.Generator().manual_seed(seed)
    measured = torch.rand(count, rows, len(features.names), generator=generator) * 2 - 1
    present = (torch.rand(count, rows, 1, generator=generator) > 0.3).float()
    present[:, 0] = 1.0
    return torch.cat((present, measured * present), -1)


def victim(action_type: ActionType, features: Features) -> Policy:
    """A network of the zoo's kind with random weights, large enough that its decisions vary."""
    from bench.victims.drivers.networks import ActorPolicy, QPolicy

    width = len(features.names) + 1
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        discrete = action_type == "discrete"
        policy: Policy = QPolicy(width, ACTIONS, HIDDEN) if discrete else ActorPolicy(width, HIDDEN, 0.5)
    with torch.no_grad():
        for weight in policy.parameters():
            weight.mul_(3.0)
    return policy.requires_grad_(False).eval()
