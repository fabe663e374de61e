"""The PPO driver: TorchRL's clipped surrogate objective and generalised advantage estimation, on the driver's own experience."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Annotated

import torch
from annotated_types import Interval
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from bench.driving import ActionType, Policy, TrainingHooks
from bench.plugins.ranges import Count, NotNegative, Share
from bench.victims.drivers.learner import CHUNK, Learner, Phase
from bench.victims.drivers.networks import QPolicy, StateValue
from bench.victims.drivers.practice import ALLOWED
from bench.victims.drivers.training import LearningDriver


@dataclass(frozen=True, kw_only=True)
class PPO(LearningDriver):
    """Proximal policy optimisation (Schulman et al. 2017) that chooses lane changes and target speeds.

    TorchRL's ClipPPOLoss with generalised advantages (Schulman et al. 2016). The policy drives greedily: the scores that an
    attack sees are the logits, and the most likely action is taken. It learns from its latest experience only, so `n_step`,
    `memory`, `tau` and `updates` have no meaning for it.

    Args:
        rollout: decisions on every road between two rounds of updates.
        epochs: how often each decision is learned from.
        clip: epsilon, the largest change of an action's probability ratio that is rewarded.
        trace: lambda of the advantages per decision of the first phase; lambda^(1/repeat) in the second.
        entropy: weight of the entropy bonus; it falls linearly to 0.
    """

    policy_type = QPolicy

    decisions: Count = 24_000
    batch: Count = 2048
    rollout: Annotated[int, Interval(ge=8)] = 64
    epochs: Count = 3
    clip: Annotated[float, Interval(gt=0, lt=1)] = 0.2
    trace: Share = 0.9
    entropy: NotNegative = 0.01

    @property
    def action_type(self) -> ActionType:
        return "discrete"

    def learner(self, env: EnvBase, hooks: TrainingHooks) -> Learner:
        return _ProximalLearner(self, env, hooks)


class _ProximalLearner(Learner):
    on_policy = True

    def __init__(self, recipe: PPO, env: EnvBase, hooks: TrainingHooks) -> None:
        super().__init__(hooks)
        self.recipe = recipe
        self.chunks: list[TensorDictBase] = []
        features, actions = env.observation_spec["observation"].shape[-1], int(env.action_spec.space.n)
        self.policy: QPolicy = QPolicy(features, actions, recipe.hidden)
        if hooks.start is not None:
            self.policy.load_state_dict(hooks.start.state_dict())
        read = ["observation", ALLOWED] if recipe.behind else ["observation"]
        actor = ProbabilisticTensorDictSequential(
            TensorDictModule(_Logits(self.policy.network), in_keys=read, out_keys=["logits"]),
            ProbabilisticTensorDictModule(
                in_keys=["logits"],
                out_keys=["action"],
                distribution_class=torch.distributions.Categorical,
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
            normalize_advantage=True,
        )
        self.adam = torch.optim.Adam(self.loss.parameters(), recipe.learning_rate)

    def enter(self, phase: Phase) -> None:
        trace = self.recipe.trace ** (phase.repeat / self.recipe.repeat)
        self.advantage = GAE(gamma=phase.gamma, lmbda=trace, value_network=self.critic)
        self.chunks = []

    def collect(self, chunk: TensorDictBase) -> None:
        self.chunks.append(chunk)

    def learn(self, rate: float, share: float) -> None:
        if len(self.chunks) * CHUNK < self.recipe.rollout:
            return
        self.loss.entropy_coeff.fill_(self.recipe.entropy * (1 - share))
        whole, self.chunks = torch.cat(self.chunks, -1), []
        with torch.no_grad():
            flat = self.advantage(whole).exclude("next").reshape(-1)
        flat.set("truth", flat["observation"])
        for _ in range(self.recipe.epochs):
            for rows in torch.randperm(len(flat)).split(self.recipe.batch):
                self.update(flat[rows], rate)

    def update(self, sample: TensorDictBase, learning_rate: float) -> None:
        self.adam.param_groups[0]["lr"] = learning_rate
        self.adam.zero_grad()
        self.hooks.loss(self.policy, sample, self._surrogate).backward()
        torch.nn.utils.clip_grad_norm_(self.loss.parameters(), 0.5)
        self.adam.step()

    def _surrogate(self, sample: TensorDictBase) -> Tensor:
        parts = self.loss(sample)
        return parts["loss_objective"] + parts["loss_critic"] + parts["loss_entropy"]

    def anneal(self) -> None:
        """Nothing: its exploration is its own uncertainty."""

    def averaged(self) -> Policy:
        return copy.deepcopy(self.policy)


class _Logits(nn.Module):
    """The logits [..., A] of a network; those of actions that are not allowed are next to impossible."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, observation: Tensor, allowed: Tensor | None = None) -> Tensor:
        logits: Tensor = self.network(observation)
        return logits if allowed is None else logits.masked_fill(~allowed, -1e4)
