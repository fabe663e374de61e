"""Projected gradient descent (PGD), the standard white-box attack."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar

import torch
from annotated_types import Interval
from torch import Tensor

from attacks.objectives import ContinuousLoss, DiscreteLoss, Objective
from bench.driving import DrivingAttack
from bench.plugins.contracts import Access
from bench.plugins.ranges import Count, Natural, Positive

if TYPE_CHECKING:
    from bench.driving import Oracle

Loss = Callable[[Tensor], Tensor]
Key = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True, kw_only=True)
class PGD(DrivingAttack):
    """Projected gradient descent (Madry et al. 2018, "Towards Deep Learning Models Resistant to Adversarial Attacks").

    Sign steps on the victim's gradient, each followed by a projection; returns the best iterate of all restarts. With
    `steps=1 step_size=1 random_start=false restarts=1` it is FGSM (Goodfellow et al. 2015). White box: access `gradients`.
    All episodes share the random starts of a step, so the result for one does not depend on the rest of the batch.

    Distance: L-inf in shares of the threat model's radius, for each feature.

    Args:
        steps: gradient steps per restart, at least 1 (default 10).
        step_size: length of a step as a share of the radius, in (0, 2] (default 0.5).
        restarts: independent starts, at least 1, all in one batch (default 4).
        random_start: start at a random point of the set instead of the true observation (default true). `margin` on a
            continuous victim needs it: its gradient at the true observation is 0.
        momentum: decay of the accumulated gradient (MI-FGSM, Dong et al. 2018), in [0, 1); 0 is plain PGD (default 0).
        objective: the loss to minimise (default `collision`); in brackets, for a continuous victim. `expected`: expected clean
            Q-value under the attacked policy (its critic's Q(x, mu(x'))). `collision`: the same, but braking counts as the best
            action (the action is evaluated as if it braked no harder than the clean one). `margin`: lead of the clean action
            over the best other one (negative distance from the clean action). `target`: lead of the best other action over the
            target (distance to the target).
        temperature: temperature of the expectation, as a share of the spread of the clean Q-values, above 0 (default 0.5).
        target_action: discrete target, at least 0 (default 3, FASTER).
        target_acceleration: continuous target, in [-1, 1] (default 1).
        target_steering: continuous target, in [-1, 1] (default 0.5).
        braking_action: index of the braking action for `collision`, at least 0 (default 4, SLOWER).

    Shapes: observation [B, V, F] in, the same out. Queries per step: 1 + restarts * (steps + 1). With a smaller query budget it
    uses fewer restarts, then fewer steps.

    Example:
        >>> from attacks.pgd import PGD
        >>> fgsm = PGD(steps=1, step_size=1.0, restarts=1, random_start=False)
    """

    access: ClassVar[Access] = "gradients"

    steps: Count = 10
    step_size: Annotated[float, Interval(gt=0, le=2)] = 0.5
    restarts: Count = 4
    random_start: bool = True
    momentum: Annotated[float, Interval(ge=0, lt=1)] = 0.0
    objective: Objective = "collision"
    temperature: Positive = 0.5
    target_action: Natural = 3
    target_acceleration: Annotated[float, Interval(ge=-1, le=1)] = 1.0
    target_steering: Annotated[float, Interval(ge=-1, le=1)] = 0.5
    braking_action: Natural = 4

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        if not len(observation) or int(oracle.remaining.min()) < 3:
            return observation
        return self.descend(observation, oracle, *self._loss(observation, oracle))

    def descend(self, observation: Tensor, oracle: Oracle, loss: Loss, key: Key) -> Tensor:
        """The descent on any loss of the victim's scores: the point with the lowest key of all restarts, [B, V, F].

        Args:
            observation: the true observation [B, V, F].
            oracle: the oracle; a budget that is too small for all restarts gets the first ones.
            loss: the loss [R, B] to descend on, of scores [R, B, A]; R is the number of restarts.
            key: the key [R, B] to compare points by, of their scores and losses.
        """
        affordable = int(oracle.remaining.min())
        restarts = min(self.restarts, affordable // 2)
        if restarts < 1:
            return observation
        steps = min(self.steps, affordable // restarts - 1)
        x = observation.expand(restarts, *observation.shape)
        if self.random_start:
            share = torch.rand((restarts, 1, *observation.shape[1:]), generator=oracle.generator) * 2 - 1
            x = oracle.project(x + share * oracle.radius)
        accumulated = torch.zeros_like(x)
        best, lowest = x, torch.full(x.shape[:2], torch.inf)
        for step in range(steps):
            asked, gradient = _ask(x, loss, key, oracle)
            if step > 0:
                best, lowest = _better(best, lowest, x, asked)
            accumulated = self.momentum * accumulated + _unit(gradient)
            x = oracle.project(x - self.step_size * oracle.radius * accumulated.sign())
        scores = oracle.scores(x)
        best, lowest = _better(best, lowest, x, key(scores, loss(scores)))
        return best[lowest.argmin(0), torch.arange(len(observation))]

    def _loss(self, observation: Tensor, oracle: Oracle) -> tuple[Loss, Key]:
        """The loss to minimise, from scores, and the key to compare iterates, from scores and loss; [..., B] each."""
        clean = oracle.scores(observation)
        if oracle.action_type == "discrete":
            discrete = DiscreteLoss(
                objective=self.objective,
                clean=clean,
                temperature=self.temperature,
                target_action=self.target_action,
                braking_action=self.braking_action,
            )
            return discrete, discrete.key
        if self.objective in ("margin", "target"):
            target = (self.target_acceleration, self.target_steering) if self.objective == "target" else None
            continuous = ContinuousLoss(clean=clean, target=target)
            return continuous, continuous.key

        def critic(action: Tensor) -> Tensor:
            if self.objective == "collision":
                acceleration = torch.maximum(action[..., :1], clean[..., :1])
                action = torch.cat((acceleration, action[..., 1:]), -1)
            return oracle.value(observation.expand(*action.shape[:-1], *observation.shape[1:]), action)

        return critic, lambda _, loss: loss


def _ask(x: Tensor, loss: Loss, key: Key, oracle: Oracle) -> tuple[Tensor, Tensor]:
    """The keys of the iterates [R, B] and the gradient of the loss [R, B, V, F], from one query."""
    keys: list[Tensor] = []

    def asked(scores: Tensor) -> Tensor:
        value = loss(scores)
        keys.append(key(scores.detach(), value.detach()))
        return value

    _, gradient = oracle.gradient(x, asked)
    return keys[0], gradient


def _unit(gradient: Tensor) -> Tensor:
    """`gradient` [R, B, V, F] scaled to a mean magnitude of 1 per episode, so that momentum averages directions."""
    scale = gradient.abs().mean((-2, -1), keepdim=True)
    return gradient / scale.clamp(min=torch.finfo(gradient.dtype).tiny)


def _better(best: Tensor, lowest: Tensor, x: Tensor, key: Tensor) -> tuple[Tensor, Tensor]:
    """Keep the better iterate for each restart and episode."""
    improved = key < lowest
    return torch.where(improved[..., None, None], x, best), torch.where(improved, key, lowest)
