"""Projected gradient descent (PGD), the standard white-box attack."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar

import torch
from annotated_types import Interval
from torch import Tensor

from cavbench.attacks.driving.candidates import best_of, better, random_starts
from cavbench.attacks.driving.critic import CriticLoss
from cavbench.attacks.driving.objectives import ContinuousLoss, DiscreteLoss, Objective, without_brake
from cavbench.attacks.driving.timing import gap_misfit, timed
from cavbench.core.contracts import Access
from cavbench.core.ranges import Count, Natural, Positive, Share
from cavbench.driving import DrivingAttack

if TYPE_CHECKING:
    from cavbench.driving import DrivingVictim, DrivingWorld, Oracle

Loss = Callable[[Tensor], Tensor]
Key = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True, kw_only=True)
class PGD(DrivingAttack):
    """Projected gradient descent (Madry et al. 2018, "Towards Deep Learning Models Resistant to Adversarial Attacks").

    Sign steps on the victim's gradient, each followed by a projection; returns the best of the true observation and all
    iterates, random starts included. With
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
        gap: attack only where the victim's preference gap is at least this, in [0, 1]; 0 attacks every frame. This is the
            strategically-timed attack (Lin et al. 2017, "Tactics of Adversarial Attack on Deep Reinforcement Learning Agents",
            Eq. 3); it makes the most of a threat model with `share` below 1. For discrete actions.
        gap_temperature: temperature T of the softmax over the Q-values in the gap, above 0.
        draw: number of the random draw: another number is the same attack with other random starts.

    Shapes: observation [B, V, F] in, the same out. Queries per step: 1 + restarts * (steps + 1). If the loss asks the critic of a
    continuous victim, every point counts twice: 2 + 2 * restarts * (steps + 1). With a smaller query budget it uses fewer
    restarts, then fewer steps.

    Example:
        >>> from cavbench.attacks.driving.pgd import PGD
        >>> fgsm = PGD(steps=1, step_size=1.0, restarts=1, random_start=False)
    """

    access: ClassVar[Access] = "gradients"
    joint: ClassVar[bool] = True

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
    gap: Share = 0.0
    gap_temperature: Positive = 0.05
    draw: Natural = 0

    def misfit(self, victim: DrivingVictim) -> str:
        return gap_misfit(self.gap, victim) or super().misfit(victim)

    def lacks(self, world: DrivingWorld) -> str:
        return without_brake(self.objective, self.braking_action, world, ("margin", "expected")) or super().lacks(world)

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        if not len(observation) or int(oracle.remaining.min()) < 1:
            return observation
        clean = oracle.scores(observation)
        return timed(self._attacked, observation, clean, oracle, gap=self.gap, temperature=self.gap_temperature)

    def _attacked(self, observation: Tensor, clean: Tensor, oracle: Oracle) -> Tensor:
        loss = self._loss(observation, clean, oracle)
        if int(oracle.remaining.min()) < 3 * loss.price - 1:
            return observation
        # The scores on the true observation are known: it is the first candidate.
        known = loss.key(clean, loss(clean))
        return self.descend(observation, oracle, loss, loss.key, price=loss.price, known=known)

    def descend(
        self, observation: Tensor, oracle: Oracle, loss: Loss, key: Key, *, price: int = 1, known: Tensor | None = None
    ) -> Tensor:
        """The descent on any loss of the victim's scores: the point with the lowest key of all restarts, [B, V, F].

        Args:
            observation: the true observation [B, V, F].
            oracle: the oracle of these episodes; a budget that is too small for all restarts gets the first ones.
            loss: the loss [R, B] to descend on, of scores [R, B, A]; R is the number of restarts.
            key: the key [R, B] to compare points by, of their scores and losses.
            price: queries for one point.
            known: the key of the true observation [B], which is then a candidate, too.
        """
        affordable = int(oracle.remaining.min()) // price
        restarts = min(self.restarts, affordable // 2)
        if restarts < 1:
            return observation
        start = observation.expand(restarts, *observation.shape)
        if self.random_start:
            start = random_starts(observation, restarts, oracle)
        steps = min(self.steps, affordable // restarts - 1)
        best, lowest = descend(start, loss, key, oracle, steps=steps, step_size=self.step_size, momentum=self.momentum)
        return best_of(best, lowest, observation, known)

    def _loss(self, observation: Tensor, clean: Tensor, oracle: Oracle) -> DiscreteLoss | ContinuousLoss | CriticLoss:
        """The objective in this step."""
        if oracle.action_type == "discrete":
            return DiscreteLoss(
                objective=self.objective,
                clean=clean,
                temperature=self.temperature,
                target_action=self.target_action,
                braking_action=self.braking_action,
            )
        if self.objective in ("margin", "target"):
            target = (self.target_acceleration, self.target_steering) if self.objective == "target" else None
            return ContinuousLoss(clean=clean, target=target)
        return CriticLoss(observation, clean, oracle, spares_braking=self.objective == "collision")


def descend(
    x: Tensor, loss: Loss, key: Key, oracle: Oracle, *, steps: int, step_size: float, momentum: float = 0.0
) -> tuple[Tensor, Tensor]:
    """Sign steps from the points `x` [R, B, V, F] of the perturbation set, with R * (steps + 1) queries of each episode.

    Returns:
        The best point of each start [R, B, V, F], the starts included, and its key [R, B]. Arguments as in `PGD.descend`.
    """
    best, lowest = x, torch.full(x.shape[:2], torch.inf)
    accumulated = torch.zeros_like(x)
    for _ in range(steps):
        keys, gradient = _ask(x, loss, key, oracle)
        best, lowest = better(best, lowest, x, keys)
        # A mean magnitude of 1 for each episode, so that momentum averages directions.
        size = gradient.abs().mean((-2, -1), keepdim=True)
        accumulated = momentum * accumulated + gradient / size.clamp(min=torch.finfo(gradient.dtype).tiny)
        x = oracle.project(x - step_size * oracle.radius * accumulated.sign())
    scores = oracle.scores(x)
    return better(best, lowest, x, key(scores, loss(scores)))


def _ask(x: Tensor, loss: Loss, key: Key, oracle: Oracle) -> tuple[Tensor, Tensor]:
    """The keys of the iterates [R, B] and the gradient of the loss [R, B, V, F], each from one query."""
    keys: list[Tensor] = []

    def asked(scores: Tensor) -> Tensor:
        value = loss(scores)
        keys.append(key(scores.detach(), value.detach()))
        return value

    _, gradient = oracle.gradient(x, asked)
    return keys[0], gradient
