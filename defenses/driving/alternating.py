"""The alternating training of a recurrent policy and its adversary, in turns, by one policy gradient with two signs."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor, nn
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from cavbench.defenses.driving.adversary import Adversary
from cavbench.defenses.driving.recurrent import RecurrentPolicy
from cavbench.driving import Policy, TrainingHooks
from cavbench.driving.victims.learner import CHUNK, Learner, Phase
from cavbench.driving.victims.logits import sampled
from cavbench.driving.victims.networks import StateValue
from cavbench.driving.victims.practice import Practice

Turn = Literal["policy", "adversary"]


@dataclass(frozen=True, kw_only=True)
class Updates:
    """How both players learn, with numbers of PPO.

    Args:
        learning_rate, adversary_rate: of the policy and of the adversary (Adam).
        rollout: decisions on every road between two rounds of updates.
        epochs: how often each decision is learned from.
        parts: minibatches in an epoch.
        clip: epsilon of PPO.
        entropy: weight of the policy's entropy bonus.
        trace: lambda of the advantages.
        guide: weight of the start's Q-function in both losses.
    """

    learning_rate: float
    adversary_rate: float
    rollout: int
    epochs: int
    parts: int
    clip: float
    entropy: float
    trace: float
    guide: float


class Game(nn.Module):
    """The policy on what the adversary shows: logits [B, T, A] and memories [B, T, M] from true observations [B, T, V, F]."""

    def __init__(self, policy: RecurrentPolicy, adversary: Adversary) -> None:
        super().__init__()
        self.policy, self.adversary = policy, adversary

    def forward(self, observation: Tensor, memory: Tensor, first: Tensor) -> tuple[Tensor, Tensor]:
        return self.policy.network.unrolled(self.adversary.shown(observation), memory[:, 0], first.squeeze(-1))


class Alternation(Learner):
    """PPO on the game of a policy and an adversary: one of them learns at a time, and the other one is frozen.

    Both follow the gradient of log pi(a | nu(s)) in their own weights: the policy times the advantage of the action, the
    adversary times minus it. The critic always learns, from the true observation.

    Args:
        policy: the policy.
        adversary: the adversary.
        start: the Q-network that the policy continues from; it guides both (`_worth`).
        how: how both learn.
    """

    def __init__(self, policy: RecurrentPolicy, adversary: Adversary, start: Policy, how: Updates) -> None:
        super().__init__(TrainingHooks())
        self.policy: RecurrentPolicy = policy
        self.adversary, self.start, self.how = adversary, start, how
        self.players: dict[Turn, nn.Module] = {"policy": policy, "adversary": adversary}
        self.turn: Turn = "adversary"
        self.chunks: list[TensorDictBase] = []
        network = StateValue(policy.shape["features"], policy.shape["hidden"])
        self.critic = TensorDictModule(network, in_keys=["observation"], out_keys=["state_value"])
        game = TensorDictModule(
            Game(policy, adversary), in_keys=["observation", "memory", "first"], out_keys=["logits", "after"]
        )
        self.explore = self.actor = ProbabilisticTensorDictSequential(game, sampled())
        self.loss = ClipPPOLoss(self.actor, self.critic, clip_epsilon=how.clip, critic_coeff=1.0)
        rates = {"policy": how.learning_rate, "adversary": how.adversary_rate}
        self.adams = {
            turn: torch.optim.Adam([*player.parameters(), *network.parameters()], rates[turn], eps=1e-5)
            for turn, player in self.players.items()
        }

    def enter(self, phase: Phase) -> None:
        self.advantage = GAE(gamma=phase.gamma, lmbda=self.how.trace, value_network=self.critic)

    def begin(self, turn: Turn) -> None:
        """Begin a turn: only this player's weights change until the next one."""
        self.turn, self.chunks = turn, []
        self.loss.entropy_coeff.fill_(self.how.entropy if turn == "policy" else 0.0)
        for name, player in self.players.items():
            player.requires_grad_(name == turn)

    def collect(self, chunk: TensorDictBase) -> None:
        self.chunks.append(chunk)

    def learn(self, learning_rate: float, share: float) -> None:
        """Learn from the last `rollout` decisions; `learning_rate` is a share of the rates of both."""
        if len(self.chunks) * CHUNK < self.how.rollout:
            return
        played: TensorDictBase = torch.cat(self.chunks, -1)
        self.chunks = []
        with torch.no_grad():
            self.advantage(played)
            played.set("worth", self._worth(played["observation"]))
        found = played.pop("advantage")
        played = played.exclude("next").set(
            "advantage", self._sign * (found - found.mean()) / found.std().clamp_min(1e-6)
        )
        for _ in range(self.how.epochs):
            for rows in torch.randperm(len(played)).chunk(self.how.parts):
                self.update(played[rows], learning_rate)

    def update(self, sample: TensorDictBase, learning_rate: float) -> None:
        adam, guide = self.adams[self.turn], self.how.guide
        adam.param_groups[0]["lr"] = adam.defaults["lr"] * learning_rate
        adam.zero_grad()
        parts = self.loss(sample)
        loss = parts["loss_objective"] + parts["loss_critic"] + parts["loss_entropy"]
        if guide:
            expected = (self.actor.get_dist(sample).probs * sample["worth"]).sum(-1).mean()
            loss = loss - guide * self._sign * expected
        loss.backward()
        for network in (self.players[self.turn], self.critic):
            nn.utils.clip_grad_norm_(network.parameters(), 0.5)
        adam.step()

    @property
    def _sign(self) -> float:
        return 1.0 if self.turn == "policy" else -1.0

    def _worth(self, observation: Tensor) -> Tensor:
        """Q_0(s, a) of the start on the true observation, less its mean over the actions, in units of its mean deviation."""
        values = self.start.scores(observation)
        return (values - values.mean(-1, keepdim=True)) / values.std(-1).mean().clamp_min(1e-6)

    def anneal(self) -> None:
        """Nothing: its exploration is its own uncertainty."""

    def averaged(self) -> Policy:
        return copy.deepcopy(self.policy)


class RecurrentPractice(Practice):
    """Practice of a policy with a memory; arguments as of `Practice`."""

    learner: Alternation

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.memory = torch.zeros(len(self.td), self.learner.policy.shape["memory"])
        self.first = torch.ones(len(self.td), 1, dtype=torch.bool)

    def decide(self, share: float) -> TensorDict:
        before = {"memory": self.memory, "first": self.first}
        seen = TensorDict({"observation": self.td["observation"], **before}, batch_size=self.td.batch_size)
        with set_exploration_type(ExplorationType.RANDOM):
            decided = self.learner.explore(seen.unsqueeze(1)).squeeze(1)
        self.td.set("action", decided["action"])
        step, self.td = self.env.step_and_maybe_reset(self.td)
        self.memory, self.first = decided["after"], step["next", "done"]
        return self.transition(step).update({**before, "action_log_prob": decided["action_log_prob"]})
