"""Soft actor-critic of discrete actions in compiled calls. `cavbench.driving.victims.sac` has the same with torch."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavbench.compiled import entry_point, inner
from cavbench.driving.fused import learning
from cavbench.driving.fused.categorical import every, log_softmax
from cavbench.driving.fused.kernels import Floats
from cavbench.driving.fused.network import Fused
from cavbench.driving.fused.q_learning import Transitions
from cavbench.driving.fused.trainable import NO_AVERAGE, Trainable


@inner
def _least(values: Floats, n: int, a: int) -> np.float32:
    """The smallest of the critics' values [C, N, A] of an action."""
    found = values[0, n, a]
    for c in range(1, len(values)):
        found = min(found, values[c, n, a])
    return found


@entry_point
def _errors(
    scores: Floats,
    values: Floats,
    known: Floats,
    scores_after: Floats,
    targets: Floats,
    action: NDArray[np.int64],
    reward: Floats,
    discount: Floats,
    alpha: float,
    gap: float,
    allowed: NDArray[np.bool_],
    allowed_after: NDArray[np.bool_],
    by_scores: Floats,
    by_values: Floats,
) -> float:
    """The gradients of the mean losses of a soft actor-critic (Christodoulou 2019, Eq. 10 to 12).

    Args:
        scores, scores_after: the actor's logits at s and s' [N, A].
        values, known: Q(s, .) of the critics in training and of those from which `gap` is found [C, N, A].
        targets: Q(s', .) of the target critics [C, N, A].
        action, reward, discount, gap, allowed, allowed_after: as of `learning.errors`.
        alpha: temperature.
        by_scores, by_values: the gradients in `scores` and `values`, filled.

    Returns:
        The mean entropy of the actor at s.
    """
    critics, count, actions = values.shape
    each, heat, share = np.float32(1) / np.float32(count), np.float32(alpha), np.float32(gap)
    logs, sure = np.empty(actions, np.float32), np.float64(0)
    for n in range(count):
        log_softmax(scores_after[n], allowed_after[n], logs)
        later = np.float32(0)
        for a in range(actions):
            if allowed_after[n, a]:
                least = _least(targets, n, a)
                later += np.exp(logs[a]) * (least - heat * logs[a])
        earned = reward[n]
        if gap > 0:
            highest = np.float32(-np.inf)
            for a in range(actions):
                if allowed[n, a]:
                    highest = max(highest, _least(known, n, a))
            earned -= share * (highest - _least(known, n, action[n]))
        aim = earned + discount[n] * later
        for c in range(critics):
            by_values[c, n] = np.float32(0)
            error = values[c, n, action[n]] - aim
            by_values[c, n, action[n]] = min(max(error, np.float32(-1)), np.float32(1)) * each
        sure += log_softmax(scores[n], allowed[n], logs)
        loss = np.float32(0)
        for a in range(actions):
            by_scores[n, a] = np.float32(0)
            if allowed[n, a]:
                by_scores[n, a] = heat * logs[a] - _least(values, n, a)
                loss += np.exp(logs[a]) * by_scores[n, a]
        for a in range(actions):
            if allowed[n, a]:
                by_scores[n, a] = each * np.exp(logs[a]) * (by_scores[n, a] - loss)
    return sure / count


class SoftActorCritic:
    """Updates an actor, its critics and the temperature on batches of transitions, and keeps averaged weights of the networks.

    The critics' loss is the smooth L1 distance to the soft value; the smallest of the critics counts.

    Args:
        actor, critics: the networks in training.
        known: networks with the weights of the critics, which follow them when `inform` is called; `gap` is found from them.
        temperature, least: alpha at the beginning, and the lowest one.
        heating: rate of Adam for log alpha.
        tau: rate at which the averaged weights follow.
        longest: norm to which the gradients of the actor, and of all critics together, are clipped.
    """

    def __init__(
        self,
        actor: Fused,
        critics: Sequence[Fused],
        known: Sequence[Fused],
        *,
        temperature: float,
        least: float,
        heating: float,
        tau: float,
        longest: float,
    ) -> None:
        self.actor, self.critics = Trainable(actor), [Trainable(critic) for critic in critics]
        self.known: list[Floats] = [one.gathered().numpy() for one in known]
        self.mean = self.actor.weights.copy()
        self.targets = [critic.weights.copy() for critic in self.critics]
        self.log_alpha = np.array([math.log(temperature)], np.float32)
        self.least, self.heating, self.tau, self.longest = np.float32(math.log(least)), heating, tau, longest
        self._moments = np.zeros((2, 1), np.float32)

    def update(self, batch: Transitions, *, gamma: float, gap: float, entropy: float, rate: float) -> None:
        """One gradient step.

        Args:
            batch: transitions [N].
            gamma: discount of a decision.
            gap: gap of advantage learning.
            entropy: target entropy.
            rate: learning rate of the networks.
        """
        np.maximum(self.log_alpha, self.least, out=self.log_alpha)
        after = self.actor.answers(batch.after)
        targets = _stacked(
            critic.answers(batch.after, weights=target)
            for critic, target in zip(self.critics, self.targets, strict=True)
        )
        scores = self.actor.forward(batch.observation)
        values = known = _stacked(critic.forward(batch.observation) for critic in self.critics)
        if gap > 0:
            pairs = zip(self.critics, self.known, strict=True)
            known = _stacked(critic.answers(batch.observation, weights=weights) for critic, weights in pairs)
        by_scores, by_values = torch.empty_like(scores), torch.empty_like(values)
        spread = _errors(
            scores.numpy(),
            values.numpy(),
            known.numpy(),
            after.numpy(),
            targets.numpy(),
            batch.action.numpy(),
            batch.reward.numpy(),
            (gamma**batch.steps * ~batch.failed).numpy(),
            self.temperature,
            gap,
            every(scores, batch.allowed).numpy(),
            every(scores, batch.allowed_after).numpy(),
            by_scores.numpy(),
            by_values.numpy(),
        )
        self.actor.backward(by_scores)
        self.actor.step(rate, longest=self.longest, average=self.mean, tau=self.tau)
        for critic, slopes in zip(self.critics, by_values, strict=True):
            critic.backward(slopes)
        norms = [float(np.linalg.norm(critic.by_weights)) for critic in self.critics]
        for critic, target, norm in zip(self.critics, self.targets, norms, strict=True):
            longest = self.longest * (norm + 1e-6) / (math.hypot(*norms) + 1e-6)
            critic.step(rate, longest=longest, average=target, tau=self.tau)
        slope = np.array([spread - entropy], np.float32)
        number = self.actor.steps
        learning.adam(
            self.log_alpha, slope, *self._moments, number, self.heating, self.actor.eps, math.inf, NO_AVERAGE, 0.0
        )

    @property
    def temperature(self) -> float:
        """Alpha."""
        return float(np.exp(self.log_alpha[0]))

    def inform(self) -> None:
        """Copy the weights of the critics into those that are `known`."""
        for known, critic in zip(self.known, self.critics, strict=True):
            known[:] = critic.weights

    def averaged(self, actor: Fused, critics: Sequence[Fused]) -> None:
        """Copy the averaged weights into other networks of the same shapes."""
        actor.assign(torch.from_numpy(self.mean))
        for critic, target in zip(critics, self.targets, strict=True):
            critic.assign(torch.from_numpy(target))


def _stacked(answers: Iterable[Tensor]) -> Tensor:
    return torch.stack([*answers])
