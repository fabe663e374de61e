"""Projected gradient descent (PGD), the standard white-box attack."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar

import torch
from annotated_types import Interval
from torch import Tensor

from cavbench.attacks.driving.objectives import ContinuousLoss, DiscreteLoss, Objective
from cavbench.core.contracts import Access
from cavbench.core.ranges import Count, Natural, Positive, Share
from cavbench.driving import DrivingAttack, parts_of

if TYPE_CHECKING:
    from cavbench.driving import DrivingVictim, Oracle

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
        if self.gap > 0 and victim.action_type != "discrete":
            return f"whose actions are {victim.action_type}: a preference gap needs discrete ones"
        return super().misfit(victim)

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        if not len(observation) or int(oracle.remaining.min()) < 1:
            return observation
        clean = oracle.scores(observation)
        if self.gap == 0:
            return self._attacked(observation, clean, oracle)
        rows = (preference_gap(clean, self.gap_temperature) >= self.gap).nonzero().squeeze(-1)
        shown = observation.clone()
        if len(rows):
            shown[rows] = self._attacked(observation[rows], clean[rows], oracle, rows)
        return shown

    def _attacked(self, observation: Tensor, clean: Tensor, oracle: Oracle, rows: Tensor | None = None) -> Tensor:
        """The attacked observations of all episodes, or of `rows`, whose clean scores are known."""
        price = self._price(oracle)
        if _left(oracle, rows) < 3 * price - 1:
            return observation
        loss, key = self._loss(observation, clean, oracle)
        # The scores on the true observation are known: it is the first candidate.
        return self.descend(observation, oracle, loss, key, rows, price=price, known=key(clean, loss(clean)))

    def descend(
        self,
        observation: Tensor,
        oracle: Oracle,
        loss: Loss,
        key: Key,
        rows: Tensor | None = None,
        *,
        price: int = 1,
        known: Tensor | None = None,
    ) -> Tensor:
        """The descent on any loss of the victim's scores: the point with the lowest key of all restarts, [B, V, F].

        Args:
            observation: the true observation [B, V, F] of all episodes, or of `rows`.
            oracle: the oracle; a budget that is too small for all restarts gets the first ones.
            loss: the loss [R, B] to descend on, of scores [R, B, A]; R is the number of restarts.
            key: the key [R, B] to compare points by, of their scores and losses.
            rows: the episodes.
            price: queries for one point.
            known: the key of the true observation [B], which is then a candidate, too.
        """
        affordable = _left(oracle, rows) // price
        restarts = min(self.restarts, affordable // 2)
        if restarts < 1:
            return observation
        steps = min(self.steps, affordable // restarts - 1)
        start = (
            random_starts(observation, restarts, oracle, rows)
            if self.random_start
            else observation.expand(restarts, *observation.shape)
        )
        best, lowest = descend(
            start, loss, key, oracle, rows, steps=steps, step_size=self.step_size, momentum=self.momentum
        )
        if known is None:
            return best[lowest.argmin(0), torch.arange(len(observation))]
        return better(observation, known, best, lowest)

    def _price(self, oracle: Oracle) -> int:
        """Queries per iterate: one, and one more where the loss asks the victim's critic."""
        return 2 if oracle.action_type == "continuous" and self.objective not in ("margin", "target") else 1

    def _loss(self, observation: Tensor, clean: Tensor, oracle: Oracle) -> tuple[Loss, Key]:
        """The loss to minimise, from scores, and the key to compare iterates, from scores and loss; [..., B] each."""
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


def random_starts(observation: Tensor, restarts: int, oracle: Oracle, rows: Tensor | None = None) -> Tensor:
    """[R, B, V, F] random points of the perturbation set; all episodes of a unit share the random numbers."""
    shape = (restarts, 1, *observation.shape[1:])
    shares = [
        torch.rand(shape, generator=part.generator).expand(-1, part.rows.stop - part.rows.start, -1, -1)
        for part in (oracle.parts if rows is None else parts_of(oracle.parts, rows))
    ]
    return oracle.project(observation + (torch.cat(shares, 1) * 2 - 1) * _radius(oracle, rows), rows)


def descend(
    x: Tensor,
    loss: Callable[[Tensor], Tensor],
    key: Callable[[Tensor, Tensor], Tensor],
    oracle: Oracle,
    rows: Tensor | None = None,
    *,
    steps: int,
    step_size: float,
    momentum: float = 0.0,
) -> tuple[Tensor, Tensor]:
    """Sign steps from the points `x` [R, B, V, F] (of all episodes, or of `rows`), with R * (steps + 1) queries.

    Args:
        x: starts in the perturbation set.
        loss: the loss to minimise [R, B], from scores.
        key: the key to compare points [R, B], from scores and loss.
        oracle: access to the victim.
        rows: the episodes.
        steps, step_size, momentum: as in `PGD`.

    Returns:
        The best point of each start [R, B, V, F], the starts included, and its key [R, B].
    """
    radius, accumulated = _radius(oracle, rows), torch.zeros_like(x)
    best, lowest = x, torch.full(x.shape[:2], torch.inf)
    for _ in range(steps):
        asked, gradient = _ask(x, loss, key, oracle, rows)
        best, lowest = _better(best, lowest, x, asked)
        accumulated = momentum * accumulated + _unit(gradient)
        x = oracle.project(x - step_size * radius * accumulated.sign(), rows)
    scores = oracle.scores(x, rows)
    return _better(best, lowest, x, key(scores, loss(scores)))


def better(observation: Tensor, known: Tensor, best: Tensor, lowest: Tensor) -> Tensor:
    """[B, V, F] the point with the lowest key; the true observation if none is below its key `known` [B].

    Args:
        observation: the true observation [B, V, F].
        known: its key [B].
        best, lowest: points [R, B, V, F] and their keys [R, B].
    """
    least, start = lowest.min(0)
    found = best[start, torch.arange(len(observation))]
    return torch.where((least < known)[:, None, None], found, observation)


def preference_gap(scores: Tensor, temperature: float) -> Tensor:
    """[B] how much the victim prefers its best action: the largest minus the smallest entry of softmax(Q / T).

    Lin et al. 2017, "Tactics of Adversarial Attack on Deep Reinforcement Learning Agents", Eq. 3.
    """
    preferred = torch.softmax(scores / temperature, -1)
    return preferred.amax(-1) - preferred.amin(-1)


def _left(oracle: Oracle, rows: Tensor | None) -> int:
    """Queries that are left for every episode, or for every one of `rows`."""
    left = oracle.remaining if rows is None else oracle.remaining[rows]
    return int(left.min()) if len(left) else 0


def _radius(oracle: Oracle, rows: Tensor | None) -> Tensor:
    return oracle.radius if rows is None else oracle.radius[rows]


def _ask(
    x: Tensor,
    loss: Callable[[Tensor], Tensor],
    key: Callable[[Tensor, Tensor], Tensor],
    oracle: Oracle,
    rows: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """The keys of the iterates [R, B] and the gradient of the loss [R, B, V, F], each from one query."""
    keys: list[Tensor] = []

    def asked(scores: Tensor) -> Tensor:
        value = loss(scores)
        keys.append(key(scores.detach(), value.detach()))
        return value

    _, gradient = oracle.gradient(x, asked, rows)
    return keys[0], gradient


def _unit(gradient: Tensor) -> Tensor:
    """`gradient` [R, B, V, F] scaled to a mean magnitude of 1 per episode, so that momentum averages directions."""
    scale = gradient.abs().mean((-2, -1), keepdim=True)
    return gradient / scale.clamp(min=torch.finfo(gradient.dtype).tiny)


def _better(best: Tensor, lowest: Tensor, x: Tensor, key: Tensor) -> tuple[Tensor, Tensor]:
    """Keep the better iterate for each restart and episode."""
    improved = key < lowest
    return torch.where(improved[..., None, None], x, best), torch.where(improved, key, lowest)
