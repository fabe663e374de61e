"""Small real victims, and highway observations for them."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from cavbench.attacks.driving.objectives import DiscreteLoss, Objective
from cavbench.driving import ActionType, DrivingAttack, Features, ObservationThreat, Oracle, Policy
from cavbench.driving.access import Enforcer
from cavbench.driving.victim import CountedPolicy
from cavbench.driving.victims.networks import ActorPolicy, QPolicy

FEATURES = Features(
    names=("x", "y", "vx", "vy"),
    low=(-100.0, -20.0, -40.0, -20.0),
    high=(100.0, 20.0, 40.0, 20.0),
    units=("m", "m", "m/s", "m/s"),
    floors=(0.5, 0.2, 0.3, 0.2),
)


class Linear(Policy):
    """Q-values linear in the observation: its gradient is the same everywhere, so an attack's optimum is known."""

    action_type = "discrete"

    def __init__(self, seed: int, rows: int = 4) -> None:
        super().__init__()
        torch.manual_seed(seed)
        self.layer = nn.Linear(rows * 5, 2)
        self.requires_grad_(False)

    def forward(self, observation: Tensor) -> Tensor:
        return self.layer(observation.flatten(-2))


def victim(action_type: ActionType, seed: int = 0) -> Policy:
    """The project's own networks with random weights large enough that decisions vary, and a state value far from 0."""
    torch.manual_seed(seed)
    policy: Policy = QPolicy(5, 5, 16) if action_type == "discrete" else ActorPolicy(5, 16, 0.5)
    with torch.no_grad():
        for weight in policy.parameters():
            weight.mul_(3.0)
    return policy.requires_grad_(False).eval()


def observations(count: int, seed: int = 0, rows: int = 4) -> Tensor:
    """[count, rows, 5] with some absent rows; the ego is always present."""
    generator = torch.Generator().manual_seed(seed)
    measured = torch.rand(count, rows, 4, generator=generator) * 2 - 1
    present = (torch.rand(count, rows, 1, generator=generator) > 0.3).float()
    present[:, 0] = 1.0
    return torch.cat((present, measured * present), -1)


def open_oracle(
    policy: Policy, attack: DrivingAttack, observation: Tensor, threat: ObservationThreat | None = None, seed: int = 0
) -> Oracle:
    """An oracle with a step begun on `observation`."""
    threat = threat or ObservationThreat(budget=0.2)
    generator = torch.Generator().manual_seed(seed)
    return Enforcer(CountedPolicy(policy), threat, attack.access, FEATURES, generator).begin(observation)


def perturb(
    attack: DrivingAttack, policy: Policy, observation: Tensor, threat: ObservationThreat | None = None, seed: int = 0
) -> tuple[Tensor, Tensor]:
    """The perturbed observation [B, V, F] and the number of queries [B]."""
    oracle = open_oracle(policy, attack, observation, threat, seed)
    shown, _ = attack.step(observation, oracle, attack.initial(observation, oracle))
    return shown, oracle.spent


def loss_of(policy: Policy, objective: Objective, observation: Tensor) -> DiscreteLoss:
    """The objective with the attacks' default temperature and actions, bound to `observation`."""
    return DiscreteLoss(
        objective=objective, clean=policy.scores(observation), temperature=0.5, target_action=3, braking_action=4
    )


def left(
    attack: DrivingAttack | None, policy: Policy, observation: Tensor, objective: Objective = "collision"
) -> Tensor:
    """[B] the attack's key for the perturbed observation; lower is a stronger attack."""
    shown = perturb(attack, policy, observation)[0] if attack else observation
    loss, scores = loss_of(policy, objective, observation), policy.scores(shown)
    return loss.key(scores, loss(scores))
