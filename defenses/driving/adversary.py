"""A learned adversary: a network that shows a driving policy other values within the perturbation set."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from cavbench.driving import ObservationThreat
from cavbench.driving.features import Features
from cavbench.driving.threat import project


class Adversary(nn.Module):
    """nu(s): a direction in [-1, 1] for every measured value of the true observation, as a share of the radius of its set.

    Each row is read together with the ego's row and with the max-pooled rows, so the order of the cars does not matter.

    Args:
        size: F, size of an observation row.
        hidden: width of the hidden layers.
        threat: the perturbation set.
        features: names and ranges of the measured features.
    """

    def __init__(self, size: int, hidden: int, threat: ObservationThreat, features: Features) -> None:
        super().__init__()
        self.threat, self.features = threat, features
        self.scale = 0.0
        """Multiplies the budget of the set."""
        self.row = nn.Linear(2 * size, hidden)
        self.pair = nn.Linear(2 * hidden, hidden)
        self.last = nn.Linear(hidden, size - 1)
        with torch.no_grad():
            self.last.weight.mul_(0.1)

    def forward(self, observation: Tensor) -> Tensor:
        """The directions [..., V, F - 1] for true observations [..., V, F]."""
        ego = observation[..., :1, 1:].expand(*observation.shape[:-1], -1)
        own = torch.zeros_like(observation[..., :1])
        own[..., 0, :] = 1.0
        rows = self.row(torch.cat((observation, ego, own), -1)).relu() * observation[..., :1]
        pooled = rows.amax(-2, keepdim=True).expand_as(rows)
        return self.last(self.pair(torch.cat((rows, pooled), -1)).relu()).tanh()

    def shown(self, observation: Tensor) -> Tensor:
        """What it shows instead of true observations [..., V, F]; a point of their sets."""
        radius = self.threat.radius(observation, self.features, self.scale)
        moved = observation[..., 1:] + radius[..., 1:] * self(observation)
        return project(torch.cat((observation[..., :1], moved), -1), observation, radius)
