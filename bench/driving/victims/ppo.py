"""The PPO driver: TorchRL's clipped surrogate objective and generalised advantage estimation, on the driver's own experience."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from typing import Annotated

import torch
from annotated_types import Interval
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from cavbench.core.ranges import Count, Natural, NotNegative, Positive, Share
from cavbench.driving import ActionType, Policy, TrainingHooks
from cavbench.driving.fused.categorical import Drawing
from cavbench.driving.fused.proximal import Proximal
from cavbench.driving.victims.learner import CHUNK, Learner, Phase
from cavbench.driving.victims.logits import Logits, sampled
from cavbench.driving.victims.networks import QPolicy, StateValue
from cavbench.driving.victims.practice import ALLOWED
from cavbench.driving.victims.training import LearningDriver


@dataclass(frozen=True, kw_only=True)
class PPO(LearningDriver):
    """Proximal policy optimisation (Schulman et al. 2017) that chooses lane changes and target speeds.

    TorchRL's ClipPPOLoss with generalised advantages (Schulman et al. 2016). The policy drives greedily: the scores that an
    attack sees are the logits, and the most likely action is taken. It drives with averaged weights.

    Its second phase, from scratch, decides at every frame and takes few careful steps: a crash is rare and comes seconds after
    the decision that led to it, so it costs more, and each update learns from more experience. For the first `settling` rounds of
    updates of this phase the critic alone learns. A phase of fewer than `fine_rollout` decisions learns nothing. With a trained
    start the updates are those of the first phase. Behind a defence it explores more than at the end of the training without one
    (`BEHIND`).

    Args:
        rollout: decisions on every road between two rounds of updates, in the first phase.
        epochs: how often each decision is learned from.
        fine_rollout: decisions on every road between two rounds of updates, in the second phase.
        fine_batch: transitions per update in the second phase.
        fine_epochs: how often each decision of the second phase is learned from.
        fine_gamma, fine_trace: discount and lambda of the second phase per `repeat` frames.
        fine_penalty: cost of a crash in the second phase, in frames of perfect driving.
        fine_rate: learning rate of the policy in the second phase.
        critic_speed: learning rate of the critic there, as a multiple of `fine_rate`.
        settling: rounds of updates at the beginning of the second phase in which the critic alone learns.
        tau: rate at which the averaged weights follow, per update.
        clip: epsilon, the largest change of an action's probability ratio that is rewarded.
        trace: lambda of the advantages per decision of the first phase.
        entropy: initial weight of the entropy bonus.
        final_entropy: its weight from `explore_until` on; it falls exponentially until then. In the second phase the
            weight is always this divided by `repeat`.
        explore_until: share of the training until which the reward for the rightmost lane grows, with the square of the share,
            to its full weight; the second phase has the full weight. With this reward from the start, the policy drives in the
            rightmost lane before it can pass, and never leaves it.
    """

    algorithm = "ppo"
    policy_type = QPolicy

    decisions: Count = 43_200
    rollout: Annotated[int, Interval(ge=8)] = 16
    epochs: Count = 3
    learning_rate: float = 7e-4
    fine: Share = 0.5
    fine_rollout: Annotated[int, Interval(ge=8)] = 256
    fine_batch: Count = 4608
    fine_gamma: Share = 0.98
    fine_trace: Share = 0.92
    fine_epochs: Count = 4
    fine_rate: Positive = 2e-4
    fine_penalty: NotNegative = 400.0
    critic_speed: Positive = 5.0
    settling: Natural = 4
    tau: Share = 0.01
    clip: Annotated[float, Interval(gt=0, lt=1)] = 0.2
    trace: Share = 0.85
    entropy: Positive = 0.5
    final_entropy: Positive = 0.02
    explore_until: Annotated[float, Interval(gt=0, le=1)] = 0.65
    behind_decisions: Count = 8_000

    @property
    def action_type(self) -> ActionType:
        return "discrete"

    def phases(self, hooks: TrainingHooks) -> list[Phase]:
        first, *second = super().phases(hooks)
        return [first, *(replace(phase, gamma=self.fine_gamma ** (1 / self.repeat)) for phase in second)]

    def learner(self, env: EnvBase, hooks: TrainingHooks) -> Learner:
        return _ProximalLearner(self, env, hooks)


SPEEDS = (20.0, 30.0)
"""The speeds in m/s between which Eq. 4.1 of the thesis rewards speed."""
SPEED = 0.8
"""The largest part of `progress` that is for speed; the rest is for the rightmost lane."""
BEHIND = 0.5
"""How far the exploration has got when the training behind a defence begins: there, a random lane change is not dangerous."""


class _ProximalLearner(Learner):
    """Drives, and remembers a rollout; how it learns is `_Compiled`, or `_Torch` if the hooks change what is learned."""

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
        self.mask = ALLOWED if recipe.behind else None
        self.critic = StateValue(features, recipe.hidden)
        self.mean: QPolicy = copy.deepcopy(self.policy)
        self.rule: _Compiled | _Torch = (_Torch if hooks.learns_otherwise else _Compiled)(self)
        self.explore = self.rule.actor
        self.fine, self.settling = False, 0

    def enter(self, phase: Phase) -> None:
        recipe = self.recipe
        self.repeat, self.fine = phase.repeat, phase.repeat == 1 and self.hooks.start is None
        self.rollout, self.epochs, self.batch = recipe.rollout, recipe.epochs, recipe.batch
        self.final = recipe.final_entropy
        if self.fine:
            self.rollout, self.epochs, self.batch = recipe.fine_rollout, recipe.fine_epochs, recipe.fine_batch
            self.explored, self.settling, self.final = 1.0, recipe.settling, self.final * phase.exploration
            self.rule.restart()
        trace = (recipe.fine_trace if self.fine else recipe.trace) ** (phase.repeat / recipe.repeat)
        self.rule.enter(phase.gamma, trace)
        self.chunks = []

    def progress(self, info: TensorDictBase) -> Tensor:
        """`progress`, whose part for the rightmost lane grows until `explore_until`."""
        if self.explored >= 1:
            harder = self.recipe.fine_penalty - self.recipe.crash_penalty if self.fine else 0.0
            return super().progress(info) - harder * (info["crashed"] | info["offroad"]).float()
        low, high = SPEEDS
        fast = SPEED * self.repeat * ((info["speed"] - low) / (high - low)).clamp(0, 1)
        return fast + self.explored**2 * (super().progress(info) - fast)

    def collect(self, chunk: TensorDictBase) -> None:
        self.chunks.append(chunk)

    def learn(self, rate: float, share: float) -> None:
        recipe = self.recipe
        if len(self.chunks) * CHUNK < self.rollout:
            return
        if not self.fine:
            self.explored = min(1.0, self.first + (1 - self.first) * share / recipe.explore_until)
        self.rule.weigh(recipe.entropy * (self.final / recipe.entropy) ** self.explored)
        whole, self.chunks = torch.cat(self.chunks, -1), []
        flat = self.rule.judged(whole)
        advantage = flat["advantage"]
        flat.set("advantage", (advantage - advantage.mean()) / advantage.std().clamp_min(1e-6))
        for _ in range(self.epochs):
            for rows in torch.randperm(len(flat)).split(self.batch):
                self.update(flat[rows], rate)
        self.settling -= 1

    def update(self, sample: TensorDictBase, learning_rate: float) -> None:
        rates = learning_rate, learning_rate
        if self.fine:
            fine = learning_rate * (self.recipe.fine_rate / self.recipe.learning_rate)
            rates = fine if self.settling <= 0 else 0.0, fine * self.recipe.critic_speed
        self.rule.update(sample, rates)

    def anneal(self) -> None:
        """Nothing: its exploration is its own uncertainty."""

    def averaged(self) -> Policy:
        return self.rule.averaged()


LONGEST, EPS = 0.5, 1e-5
"""The norm to which gradients are clipped, and what Adam adds to the root of its second moment."""


class _Compiled:
    """The same algorithm as `_Torch` in compiled calls (`cavbench.driving.fused`), equal to rounding."""

    def __init__(self, learner: _ProximalLearner) -> None:
        self.mean, self.mask, recipe = learner.mean, learner.mask, learner.recipe
        networks = learner.policy.network.fused, learner.critic.fused
        self.learning = Proximal(*networks, clip=recipe.clip, tau=recipe.tau, longest=LONGEST, eps=EPS)
        self.actor = Drawing(self.learning.actor, self.mask, log_prob="action_log_prob")
        self.entropy = recipe.entropy

    def restart(self) -> None:
        self.learning.restart()

    def enter(self, gamma: float, trace: float) -> None:
        self.gamma, self.trace = gamma, trace

    def weigh(self, entropy: float) -> None:
        self.entropy = entropy

    def judged(self, whole: TensorDictBase) -> TensorDictBase:
        advantage, target = self.learning.judged(whole, gamma=self.gamma, trace=self.trace)
        flat = whole.exclude("next").set("advantage", advantage.unsqueeze(-1))
        return flat.set("value_target", target.unsqueeze(-1)).reshape(-1)

    def update(self, sample: TensorDictBase, rates: tuple[float, float]) -> None:
        allowed = None if self.mask is None else sample[self.mask]
        self.learning.update(sample, allowed, self.entropy, rates)

    def averaged(self) -> QPolicy:
        self.mean.network.fused.assign(torch.from_numpy(self.learning.mean))
        return copy.deepcopy(self.mean)


class _Torch:
    """TorchRL's loss and advantages, torch's Adam."""

    def __init__(self, learner: _ProximalLearner) -> None:
        self.policy, self.mean, self.hooks, recipe = learner.policy, learner.mean, learner.hooks, learner.recipe
        self.rate, self.tau = recipe.learning_rate, recipe.tau
        read = ["observation"] if learner.mask is None else ["observation", learner.mask]
        self.actor = ProbabilisticTensorDictSequential(
            TensorDictModule(Logits(self.policy.network), in_keys=read, out_keys=["logits"]),
            sampled(),
        )
        self.critic = TensorDictModule(learner.critic, in_keys=["observation"], out_keys=["state_value"])
        self.loss = ClipPPOLoss(
            self.actor,
            self.critic,
            clip_epsilon=recipe.clip,
            entropy_coeff=recipe.entropy,
            critic_coeff=1.0,
            reduction="none",
        )
        self.restart()

    def restart(self) -> None:
        """Forget the moments of Adam."""
        parts = [{"params": list(part.parameters())} for part in (self.policy, self.critic)]
        self.adam = torch.optim.Adam(parts, self.rate, eps=EPS)

    def enter(self, gamma: float, trace: float) -> None:
        """Set the discount of a decision and lambda."""
        self.advantage = GAE(gamma=gamma, lmbda=trace, value_network=self.critic)

    def weigh(self, entropy: float) -> None:
        """Set the weight of the entropy bonus."""
        self.loss.entropy_coeff.fill_(entropy)

    @torch.no_grad()
    def judged(self, whole: TensorDictBase) -> TensorDictBase:
        """Decisions [B, T] in one row [N], with their `advantage` and `value_target` [N, 1]."""
        flat = self.advantage(whole).exclude("next").reshape(-1)
        return flat.set("truth", flat["observation"])

    def update(self, sample: TensorDictBase, rates: tuple[float, float]) -> None:
        """One gradient step; `rates` are those of the policy and the critic."""
        for group, rate in zip(self.adam.param_groups, rates, strict=True):
            group["lr"] = rate
        self.adam.zero_grad()
        self.hooks.loss(self.policy, sample, self._surrogate).mean().backward()
        for network in (self.policy, self.critic):
            torch.nn.utils.clip_grad_norm_(network.parameters(), LONGEST)
        self.adam.step()
        for mean, own in zip(self.mean.parameters(), self.policy.parameters(), strict=True):
            mean.data.lerp_(own.data, self.tau)

    def averaged(self) -> QPolicy:
        """A copy of the averaged policy."""
        return copy.deepcopy(self.mean)

    def _surrogate(self, sample: TensorDictBase) -> Tensor:
        parts = self.loss(sample)
        loss: Tensor = parts["loss_objective"] + parts["loss_critic"] + parts["loss_entropy"]
        return loss.flatten()
