"""Gradient descent on surrogates: networks that the attacker has, in place of a victim that it has not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar

import torch
from annotated_types import Interval
from torch import Tensor, nn

from cavbench.attacks.driving.candidates import random_starts
from cavbench.attacks.driving.objectives import ContinuousLoss, DiscreteLoss, Objective
from cavbench.core.ranges import Count, Natural, Positive, Share
from cavbench.driving import DrivingAttack, Policy
from cavbench.driving.gradients import Tangent
from cavbench.driving.victim import CountedPolicy

if TYPE_CHECKING:
    from cavbench.driving import Oracle


class Surrogates(nn.Module):
    """The policies that stand in for the victim."""

    def __init__(self, policies: Sequence[Policy]) -> None:
        super().__init__()
        self.policies = nn.ModuleList(policies)


@dataclass(frozen=True, kw_only=True)
class SurrogateAttack(DrivingAttack):
    """The base of attacks that descend on surrogates and never ask the victim in a run.

    Args:
        steps: gradient steps per restart, at least 1.
        restarts: independent random starts, at least 1.
        step_size: length of a step as a share of the radius, in (0, 2].
        momentum: decay of the accumulated gradient, in [0, 1]; 1 sums all gradients.
        objective: the loss of each surrogate, as in `pgd`.
        temperature: temperature of an expectation, as a share of the spread of the Q-values, above 0.
        target_action: discrete target, at least 0.
        target_acceleration: continuous target, in [-1, 1].
        target_steering: continuous target, in [-1, 1].
        braking_action: index of the braking action for `collision`, at least 0.
    """

    judges: ClassVar[bool] = True
    """Whether continuous surrogates have a critic; without one, `collision` and `expected` are `target`."""

    steps: Count = 10
    restarts: Count = 2
    step_size: Annotated[float, Interval(gt=0, le=2)] = 0.5
    momentum: Share = 1.0
    objective: Objective = "collision"
    temperature: Positive = 0.5
    target_action: Natural = 3
    target_acceleration: Annotated[float, Interval(ge=-1, le=1)] = 1.0
    target_steering: Annotated[float, Interval(ge=-1, le=1)] = 0.5
    braking_action: Natural = 4

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        assert isinstance(self.adversary, Surrogates)
        if not len(observation):
            return observation
        losses = [_Loss(self, policy, observation) for policy in self.adversary.policies]
        x = random_starts(observation, self.restarts, oracle)
        accumulated = torch.zeros_like(x)
        for _ in range(self.steps):
            slopes = (loss.slope(x) for loss in losses)
            accumulated = self.momentum * accumulated + sum(_unit(slope) for slope in slopes)
            x = oracle.project(x - self.step_size * oracle.radius * accumulated.sign())
        return _best(x, observation, losses)


class _Loss:
    """The loss [..., B] of one surrogate at points [..., B, V, F]; lower is better for the attacker."""

    def __init__(self, attack: SurrogateAttack, policy: nn.Module, observation: Tensor) -> None:
        assert isinstance(policy, Policy)
        # Policies compute in single precision, whatever the attack is asked in.
        self.subject, self.truth, self.attack = CountedPolicy(policy), observation.float(), attack
        self.clean = self.subject.answered(self.truth, None)
        values = attack.objective in ("collision", "expected")
        target = (attack.target_acceleration, attack.target_steering)
        self.of_action = ContinuousLoss(clean=self.clean, target=None if attack.objective == "margin" else target)
        self.judges = policy.action_type == "continuous" and values and attack.judges
        if policy.action_type == "discrete":
            self.of_scores = DiscreteLoss(
                objective=attack.objective,
                clean=self.clean,
                temperature=attack.temperature,
                target_action=attack.target_action,
                braking_action=attack.braking_action,
            )

    def __call__(self, x: Tensor) -> Tensor:
        scores = self.subject.answered(x.float().flatten(0, -3), None).unflatten(0, x.shape[:-2])
        loss = self._loss(scores)
        return self.of_scores.key(scores, loss) if self.subject.action_type == "discrete" else loss

    def slope(self, x: Tensor) -> Tensor:
        """The gradient of the loss, [..., B, V, F]; 0 where it is NaN or infinite."""
        leading = x.shape[:-2]
        _, gradient = self.subject.differentiated(
            x.float().flatten(0, -3), None, lambda scores: self._loss(scores.unflatten(0, leading))
        )
        return gradient.reshape(x.shape).nan_to_num(0.0, 0.0, 0.0).to(x.dtype)

    def _loss(self, scores: Tensor) -> Tensor:
        if self.subject.action_type == "discrete":
            return self.of_scores(scores)
        if not self.judges:
            return self.of_action(scores)
        action = scores
        if self.attack.objective == "collision":
            action = torch.cat((torch.maximum(action[..., :1], self.clean[..., :1]), action[..., 1:]), -1)
        seen = self.truth.expand(*action.shape[:-1], *self.truth.shape[1:])
        value, gradient = self.subject.valued(seen.flatten(0, -3), action.flatten(0, -2), None)
        assert gradient is not None
        return Tangent.apply(action, value.reshape(action.shape[:-1]), gradient.reshape(action.shape))


def _unit(slope: Tensor) -> Tensor:
    """The gradient [..., V, F] with a mean magnitude of 1 in each episode, so that every surrogate counts as much."""
    size = slope.abs().mean((-2, -1), keepdim=True)
    return slope / size.clamp(min=torch.finfo(slope.dtype).tiny)


def _best(x: Tensor, observation: Tensor, losses: Sequence[_Loss]) -> Tensor:
    """Of the points [R, B, V, F] the one that lowers the surrogates' losses most, [B, V, F]; the truth if none lowers them.

    What a surrogate loses counts as a share of the most that it loses or gains at any of the points.
    """
    change = torch.zeros(x.shape[:2])
    for loss in losses:
        own = loss(x) - loss(observation[None])
        change += own / own.abs().amax(0).clamp(min=1e-9)
    least, start = change.min(0)
    found = x[start, torch.arange(len(observation))]
    return torch.where((least < 0)[:, None, None], found, observation)
