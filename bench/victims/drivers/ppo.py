"""The PPO driver: TorchRL's clipped surrogate objective and generalised advantage estimation, on the driver's own experience."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from typing import Annotated

import torch
from annotated_types import Interval
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from bench.driving import ActionType, Policy, TrainingHooks
from bench.plugins.ranges import Count, Positive, Share
from bench.victims.drivers.learner import CHUNK, Learner, Phase
from bench.victims.drivers.logits import Logits
from bench.victims.drivers.networks import QPolicy, StateValue
from bench.victims.drivers.practice import ALLOWED
from bench.victims.drivers.training import LearningDriver


@dataclass(frozen=True, kw_only=True)
class PPO(LearningDriver):
    """Proximal policy optimisation (Schulman et al. 2017) that chooses lane changes and target speeds.

    TorchRL's ClipPPOLoss with generalised advantages (Schulman et al. 2016). The policy drives greedily: the scores that an
    attack sees are the logits, and the most likely action is taken. It learns from its latest experience only, so `n_step`,
    `memory`, `tau` and `updates` have no meaning for it.

    From scratch it has no phase of single frames: the policy that holds decisions for `repeat` frames scores as well if it is
    asked at every frame. `fine` is the share of the training, at its end, over which the checkpoints are spread. Behind a defence
    it explores more than at the end of the training without one (`BEHIND`).

    Args:
        rollout: decisions on every road between two rounds of updates.
        epochs: how often each decision is learned from.
        clip: epsilon, the largest change of an action's probability ratio that is rewarded.
        trace: lambda of the advantages per decision of the first phase; lambda^(1/repeat) in the second.
        entropy: initial weight of the entropy bonus.
        final_entropy: its weight from `explore_until` on; it falls exponentially until then.
        explore_until: share of the training until which the reward for the rightmost lane grows, with the square of the share,
            to its full weight. With this reward from the start, the policy drives in the rightmost lane before it can pass, and
            never leaves it.
    """

    algorithm = "ppo"
    policy_type = QPolicy

    decisions: Count = 36_000
    rollout: Annotated[int, Interval(ge=8)] = 16
    epochs: Count = 3
    learning_rate: float = 7e-4
    clip: Annotated[float, Interval(gt=0, lt=1)] = 0.2
    trace: Share = 0.85
    entropy: Positive = 0.5
    final_entropy: Positive = 0.02
    explore_until: Annotated[float, Interval(gt=0, le=1)] = 0.8
    behind_decisions: Count = 8_000

    @property
    def action_type(self) -> ActionType:
        return "discrete"

    def phases(self, hooks: TrainingHooks) -> list[Phase]:
        phases = super().phases(hooks)
        if hooks.start is not None:
            return phases
        return [replace(phases[0], decisions=sum(phase.decisions for phase in phases))]

    def learner(self, env: EnvBase, hooks: TrainingHooks) -> Learner:
        return _ProximalLearner(self, env, hooks)


SPEEDS = (20.0, 30.0)
"""The speeds in m/s between which Eq. 4.1 of the thesis rewards speed."""
SPEED = 0.8
"""The largest part of `progress` that is for speed; the rest is for the rightmost lane."""
BEHIND = 0.5
"""How far the exploration has got when the training behind a defence begins: there, a random lane change is not dangerous."""


class _ProximalLearner(Learner):
    on_policy = True

    def __init__(self, recipe: PPO, env: EnvBase, hooks: TrainingHooks) -> None:
        super().__init__(hooks)
        self.recipe = recipe
        self.chunks: list[TensorDictBase] = []
        self.first = 0.0 if hooks.start is None else BEHIND if recipe.behind else 1.0
        self.explored = self.first
        features, actions = env.observation_spec["observation"].shape[-1], int(env.action_spec.space.n)
        self.policy: QPolicy = QPolicy(features, actions, recipe.hidden)
        if hooks.start is not None:
            self.policy.load_state_dict(hooks.start.state_dict())
        else:
            with torch.no_grad():
                self.policy.network.head[-1].weight.mul_(0.1)
        read = ["observation", ALLOWED] if recipe.behind else ["observation"]
        actor = ProbabilisticTensorDictSequential(
            TensorDictModule(Logits(self.policy.network), in_keys=read, out_keys=["logits"]),
            ProbabilisticTensorDictModule(
                in_keys=["logits"],
                out_keys=["action"],
                distribution_class=torch.distributions.Categorical,
                distribution_kwargs={"validate_args": False},
                return_log_prob=True,
                log_prob_key="action_log_prob",
            ),
        )
        self.explore = actor
        self.critic = TensorDictModule(
            StateValue(features, recipe.hidden), in_keys=["observation"], out_keys=["state_value"]
        )
        self.loss = ClipPPOLoss(
            actor,
            self.critic,
            clip_epsilon=recipe.clip,
            entropy_coeff=recipe.entropy,
            critic_coeff=1.0,
            reduction="none",
        )
        self.adam = torch.optim.Adam(self.loss.parameters(), recipe.learning_rate, eps=1e-5)

    def enter(self, phase: Phase) -> None:
        self.repeat = phase.repeat
        trace = self.recipe.trace ** (phase.repeat / self.recipe.repeat)
        self.advantage = GAE(gamma=phase.gamma, lmbda=trace, value_network=self.critic)
        self.chunks = []

    def progress(self, info: TensorDictBase) -> Tensor:
        """`progress`, whose part for the rightmost lane grows until `explore_until`."""
        if self.explored >= 1:
            return super().progress(info)
        low, high = SPEEDS
        fast = SPEED * self.repeat * ((info["speed"] - low) / (high - low)).clamp(0, 1)
        return fast + self.explored**2 * (super().progress(info) - fast)

    def collect(self, chunk: TensorDictBase) -> None:
        self.chunks.append(chunk)

    def learn(self, rate: float, share: float) -> None:
        recipe = self.recipe
        if len(self.chunks) * CHUNK < recipe.rollout:
            return
        self.explored = min(1.0, self.first + (1 - self.first) * share / recipe.explore_until)
        self.loss.entropy_coeff.fill_(recipe.entropy * (recipe.final_entropy / recipe.entropy) ** self.explored)
        whole, self.chunks = torch.cat(self.chunks, -1), []
        with torch.no_grad():
            flat = self.advantage(whole).exclude("next").reshape(-1)
        advantage = flat["advantage"]
        flat.set("advantage", (advantage - advantage.mean()) / advantage.std().clamp_min(1e-6))
        flat.set("truth", flat["observation"])
        for _ in range(recipe.epochs):
            for rows in torch.randperm(len(flat)).split(recipe.batch):
                self.update(flat[rows], rate)

    def update(self, sample: TensorDictBase, learning_rate: float) -> None:
        self.adam.param_groups[0]["lr"] = learning_rate
        self.adam.zero_grad()
        self.hooks.loss(self.policy, sample, self._surrogate).mean().backward()
        for network in (self.policy, self.critic):
            torch.nn.utils.clip_grad_norm_(network.parameters(), 0.5)
        self.adam.step()

    def _surrogate(self, sample: TensorDictBase) -> Tensor:
        parts = self.loss(sample)
        loss: Tensor = parts["loss_objective"] + parts["loss_critic"] + parts["loss_entropy"]
        return loss.flatten()

    def anneal(self) -> None:
        """Nothing: its exploration is its own uncertainty."""

    def averaged(self) -> Policy:
        return copy.deepcopy(self.policy)
