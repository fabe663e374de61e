"""Proximal policy optimisation in compiled calls. `cavbench.driving.victims.ppo` has the same with torch, the reference."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from cavbench.compiled import entry_point
from cavbench.driving.fused.categorical import every, log_softmax
from cavbench.driving.fused.kernels import Floats
from cavbench.driving.fused.network import Fused
from cavbench.driving.fused.trainable import Trainable


@entry_point
def _surrogate(
    scores: Floats,
    allowed: NDArray[np.bool_],
    action: NDArray[np.int64],
    before: Floats,
    advantage: Floats,
    clip: float,
    entropy: float,
    by_scores: Floats,
) -> None:
    """The gradient of the mean clipped objective with an entropy bonus in the scores (Schulman et al. 2017, Eq. 7 and 9).

    Args:
        scores: logits [N, A].
        allowed: the actions that a defence leaves [N, A].
        action, before: the actions taken [N], and their log-probabilities then.
        advantage: their advantages [N].
        clip: epsilon.
        entropy: weight of the entropy.
        by_scores: [N, A], filled.
    """
    count, actions = scores.shape
    each, bonus = np.float32(1) / np.float32(count), np.float32(entropy)
    low, high = np.float32(np.log1p(-clip)), np.float32(np.log1p(clip))
    logs = np.empty(actions, np.float32)
    for n in range(count):
        spread = log_softmax(scores[n], allowed[n], logs)
        change, gain = logs[action[n]] - before[n], advantage[n]
        clipped = change > high if gain > 0 else change < low
        slope = np.float32(0) if clipped else -gain * np.exp(change)
        for a in range(actions):
            by_scores[n, a] = np.float32(0)
            if allowed[n, a]:
                share = np.exp(logs[a])
                taken = np.float32(1) if a == action[n] else np.float32(0)
                by_scores[n, a] = each * (slope * (taken - share) + bonus * share * (logs[a] + spread))


@entry_point
def _advantages(
    values: Floats,
    after: Floats,
    reward: Floats,
    done: NDArray[np.bool_],
    terminated: NDArray[np.bool_],
    gamma: float,
    trace: float,
    advantage: Floats,
) -> None:
    for b in range(len(values)):
        later = np.float32(0)
        for t in range(values.shape[1] - 1, -1, -1):
            goes_on = np.float32(0) if terminated[b, t] else np.float32(gamma)
            follows = np.float32(0) if done[b, t] else np.float32(gamma * trace)
            later = reward[b, t] + goes_on * after[b, t] - values[b, t] + follows * later
            advantage[b, t] = later


def advantages(
    values: Tensor, after: Tensor, reward: Tensor, done: Tensor, terminated: Tensor, *, gamma: float, trace: float
) -> Tensor:
    """Generalised advantages [B, T] (Schulman et al. 2016, Eq. 16) of T decisions in a row.

    Args:
        values, after: V(s) and V(s') [B, T].
        reward: [B, T].
        done, terminated: whether an episode ended with the decision, and whether in a failure [B, T].
        gamma: discount of a decision, in [0, 1].
        trace: lambda, in [0, 1].
    """
    found = torch.empty_like(values)
    given = (one.contiguous().numpy() for one in (values, after, reward, done, terminated))
    _advantages(*given, gamma, trace, found.numpy())
    return found


class Proximal:
    """Updates a policy and its critic on what the policy did, and keeps the policy's averaged weights.

    The critic's loss is the smooth L1 distance to the advantage plus the value that it had.

    Args:
        actor, critic: the networks in training, of logits and of the state's value.
        clip: epsilon, the largest change of an action's probability ratio that is rewarded.
        tau: rate at which the averaged weights follow, per update.
        longest: norm to which the gradient of each network is clipped.
        eps: as of `torch.optim.Adam`.
    """

    def __init__(self, actor: Fused, critic: Fused, *, clip: float, tau: float, longest: float, eps: float) -> None:
        self.actor, self.critic = Trainable(actor, eps=eps), Trainable(critic, eps=eps)
        self.clip, self.tau, self.longest = clip, tau, longest
        self.mean = self.actor.weights.copy()

    def judged(self, decisions: TensorDictBase, *, gamma: float, trace: float) -> tuple[Tensor, Tensor]:
        """The advantages [B, T] of decisions [B, T], and what the critic learns from them."""
        seen, shape = decisions["observation"], decisions.batch_size
        values, after = (
            self.critic.answers(one.flatten(0, 1)).view(shape) for one in (seen, decisions["next", "observation"])
        )
        ends = (decisions["next", name].view(shape) for name in ("reward", "done", "terminated"))
        found = advantages(values, after, *ends, gamma=gamma, trace=trace)
        return found, found + values

    def update(
        self, sample: TensorDictBase, allowed: Tensor | None, entropy: float, rates: tuple[float, float]
    ) -> None:
        """One gradient step.

        Args:
            sample: decisions [N] with their `action_log_prob`, `advantage` and `value_target` [N, 1].
            allowed: the actions that a defence leaves [N, A]; None for all.
            entropy: weight of the entropy.
            rates: learning rates of the policy and the critic.
        """
        policy_rate, critic_rate = rates
        scores = self.actor.forward(sample["observation"])
        _surrogate(
            scores.numpy(),
            every(scores, allowed).numpy(),
            sample["action"].numpy(),
            sample["action_log_prob"].numpy(),
            sample["advantage"].view(-1).numpy(),
            self.clip,
            entropy,
            (by_scores := torch.empty_like(scores)).numpy(),
        )
        self.actor.backward(by_scores)
        self.actor.step(policy_rate, longest=self.longest, average=self.mean, tau=self.tau)
        values = self.critic.forward(sample["observation"])
        self.critic.backward((values - sample["value_target"]).clamp(-1, 1) / len(values))
        self.critic.step(critic_rate, longest=self.longest)

    def restart(self) -> None:
        """Forget the moments of Adam."""
        self.actor.restart()
        self.critic.restart()
