"""Training with the regulariser of state-adversarial reinforcement learning."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor

from cavbench.core.ranges import NotNegative
from cavbench.defenses.driving.robust_loss import Own, RobustLoss, Worst
from cavbench.driving import Policy


@dataclass(frozen=True, kw_only=True)
class StateAdversarial(RobustLoss):
    """Trains decisions that do not change within the perturbation set (Zhang et al. 2020, arXiv 2003.08938).

    Adds to the victim's own loss, at the worst point s' of the set around each observation s: for discrete actions the hinge
    max(max_{a != a*} Q(s', a) - Q(s', a*), -lead) with a* = argmax_a Q(s, a) (SA-DQN), for continuous ones |mu(s') - mu(s)|
    (SA-DDPG).

    Args:
        weight: the paper's kappa; 0 is the control: the same training without the regulariser.
        lead: the lead of the best action over all others that is enough, the paper's c; a value of 1 is perfect driving forever.
            Discrete actions only.
    """

    name: ClassVar[str] = "sa"

    weight: NotNegative = 0.03
    lead: NotNegative = 0.02

    def loss(self, policy: Policy, sample: TensorDictBase, own: Own, worst: Worst) -> Tensor:
        with torch.no_grad():
            clean = policy.scores(sample["observation"])
        if policy.action_type == "discrete":
            least, best = -self.lead, clean.argmax(-1, keepdim=True)
        else:
            least = 0.0

        def changed(observation: Tensor) -> Tensor:
            scores = policy.scores(observation)
            if policy.action_type == "discrete":
                others = scores.scatter(-1, best, -torch.inf).amax(-1)
                return others - scores.gather(-1, best).squeeze(-1)
            return (scores - clean).norm(dim=-1)

        return own(sample) + self.weight * changed(worst(changed)).clamp(min=least)
