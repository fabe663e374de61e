"""The SAC driver: TorchRL's soft actor-critic for discrete actions, with a target entropy that falls."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Annotated, Any, cast

import torch
from annotated_types import Interval
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictSequential,
)
from torch import Tensor, nn
from torchrl.data import Categorical
from torchrl.envs import EnvBase
from torchrl.modules import EGreedyModule
from torchrl.objectives import DiscreteSACLoss, SoftUpdate, ValueEstimators

from cavbench.core.ranges import Count, Positive, Share
from cavbench.driving import ActionType, Policy, TrainingHooks
from cavbench.driving.fused.categorical import Drawing
from cavbench.driving.fused.network import Fused
from cavbench.driving.fused.q_learning import Transitions
from cavbench.driving.fused.soft import SoftActorCritic
from cavbench.driving.victims.learner import CHUNK, Learner, Phase, copy_weights
from cavbench.driving.victims.logits import Logits, SoftPolicy
from cavbench.driving.victims.networks import QNetwork
from cavbench.driving.victims.practice import ALLOWED
from cavbench.driving.victims.replay import Compiled, OffPolicyDriver, OffPolicyLearner

EntropyShare = Annotated[float, Interval(gt=0, lt=1)]


@dataclass(frozen=True, kw_only=True)
class SAC(OffPolicyDriver):
    """Soft actor-critic (Haarnoja et al. 2018) for discrete actions (Christodoulou 2019): lane changes and target speeds.

    TorchRL's DiscreteSACLoss with n-step returns, a temperature that is learned for a target entropy, and
    Polyak-averaged weights of critics and actor. The policy drives greedily: the scores that an attack sees are the logits of
    the averaged actor, and the most likely action is taken.

    Args:
        critics: number of critics; the smallest of their values counts.
        entropy: initial target entropy, as a share of the largest one, log A.
        final_entropy: target entropy from `explore_until` on; it falls exponentially until then.
        explore_until: share of the training until which the target entropy falls.
        final_epsilon: share of uniformly random actions after the first 30 % of the training; it falls linearly from 1 until
            then. Without them a lane change is hardly ever tried before the critics know where it is safe.
        temperature: initial temperature alpha, on the scale of the reward (1 is the value of perfect driving for ever).
        least_temperature: lowest alpha. Below it the actor is as good as greedy, and no longer follows its critics.
        temperature_rate: rate of Adam for log alpha.
    """

    algorithm = "sac"
    policy_type = SoftPolicy

    decisions: Count = 36_000
    batch: Count = 512
    critics: Count = 1
    entropy: EntropyShare = 0.9
    final_entropy: EntropyShare = 0.03
    final_epsilon: Share = 0.02
    explore_until: Annotated[float, Interval(gt=0, le=1)] = 0.4
    temperature: Positive = 0.01
    least_temperature: Positive = 5e-4
    temperature_rate: Positive = 3e-3

    @property
    def action_type(self) -> ActionType:
        return "discrete"

    def learner(self, env: EnvBase, hooks: TrainingHooks) -> Learner:
        return _SoftLearner(self, env, hooks)


class _AveragedSACLoss(DiscreteSACLoss):
    """The loss with target parameters for the actor, too. They are not part of the loss; the policy drives with them."""

    delay_actor = True


class _SoftLearner(OffPolicyLearner):
    """Drives, and remembers; how it learns is `_Compiled`, or `_Torch` if the hooks change what is learned."""

    def __init__(self, recipe: SAC, env: EnvBase, hooks: TrainingHooks) -> None:
        super().__init__(hooks, memory=recipe.memory, batch=recipe.batch, updates=recipe.updates)
        self.recipe, self.decisions = recipe, 0
        batch, _, features = env.observation_spec["observation"].shape
        actions = int(env.action_spec.space.n)
        self.policy: SoftPolicy = SoftPolicy(features, actions, recipe.hidden, recipe.critics)
        self.mean = SoftPolicy(features, actions, recipe.hidden, recipe.critics)
        self.policy.temperature.fill_(recipe.temperature)
        if hooks.start is not None:
            self.policy.load_state_dict(hooks.start.state_dict())
        self.mask = ALLOWED if recipe.behind else None
        self.largest_entropy = math.log(actions)
        self.uniform = EGreedyModule(
            Categorical(actions, shape=(batch,)),
            eps_init=1.0 if hooks.start is None else recipe.final_epsilon,
            eps_end=recipe.final_epsilon,
            annealing_num_steps=math.ceil(0.3 * recipe.decisions / CHUNK),
            action_mask_key=self.mask,
        )
        self.rule: _Compiled | _Torch = (_Torch if hooks.learns_otherwise else _Compiled)(self)
        # What is trained are twins, which start with the policy's critics; the policy's are copies of them.
        self.policy.critics.requires_grad_(False)
        self.explore = TensorDictSequential(self.rule.actor, self.uniform)

    def enter(self, phase: Phase) -> None:
        super().enter(phase)
        self.rule.enter(phase)
        self.rule.aim(self._entropy())
        if phase.exploration < 1:
            self.uniform.eps_end.fill_(self.recipe.final_epsilon * phase.exploration)
            self.uniform.eps.fill_(self.recipe.final_epsilon * phase.exploration)

    def update(self, sample: TensorDictBase, learning_rate: float) -> None:
        self.rule.update(sample, learning_rate)

    @torch.no_grad()
    def anneal(self) -> None:
        self.decisions += CHUNK
        self.uniform.step()
        self.rule.aim(self._entropy())
        self.rule.inform()

    def _entropy(self) -> float:
        """The target entropy."""
        recipe = self.recipe
        done = self.decisions / (recipe.explore_until * recipe.decisions) if self.hooks.start is None else 1.0
        share = recipe.entropy * (recipe.final_entropy / recipe.entropy) ** min(1.0, done)
        return share * self.largest_entropy

    def averaged(self) -> Policy:
        self.rule.average(self.mean)
        self.mean.temperature.copy_(self.policy.temperature)
        return self.mean


LONGEST = 10.0
"""The norm to which the gradients of the actor and of the critics are clipped."""


class _Compiled(Compiled):
    """The same algorithm as `_Torch` in compiled calls, equal to rounding."""

    def __init__(self, learner: _SoftLearner) -> None:
        super().__init__(learner.mask)
        recipe, self.policy = learner.recipe, learner.policy
        twins = copy.deepcopy(self.policy.critics)
        self.learning = SoftActorCritic(
            self.policy.network.fused,
            _fused(twins),
            _fused(self.policy.critics),
            temperature=float(self.policy.temperature),
            least=recipe.least_temperature,
            heating=recipe.temperature_rate,
            tau=recipe.tau,
            longest=LONGEST,
        )
        self.actor = Drawing(self.learning.actor, self.mask)

    def enter(self, phase: Phase) -> None:
        self.gamma, self.gap = phase.gamma, phase.gap

    def aim(self, entropy: float) -> None:
        self.entropy = entropy

    def descend(self, batch: Transitions, rate: float) -> None:
        self.learning.update(batch, gamma=self.gamma, gap=self.gap, entropy=self.entropy, rate=rate)

    def inform(self) -> None:
        self.learning.inform()
        self.policy.temperature.fill_(self.learning.temperature)

    def average(self, policy: SoftPolicy) -> None:
        self.learning.averaged(policy.network.fused, _fused(policy.critics))


class _Torch:
    """TorchRL's loss, torch's Adam."""

    def __init__(self, learner: _SoftLearner) -> None:
        self.policy, self.hooks, self.mask, recipe = learner.policy, learner.hooks, learner.mask, learner.recipe
        self.actor = self._actor(self.policy)
        self.loss = _AveragedSACLoss(
            self.actor,
            _critic(self.policy.critics[0]),
            action_space="categorical",
            num_actions=self.policy.shape["actions"],
            num_qvalue_nets=recipe.critics,
            alpha_init=float(self.policy.temperature),
            min_alpha=recipe.least_temperature,
            deactivate_vmap=True,
            reduction="none",
            scalar_output_mode="exclude",
        )
        twins = torch.stack([TensorDict.from_module(_critic(critic)).data for critic in self.policy.critics])
        self.loss.qvalue_network_params.data.update_(twins)
        self.target = SoftUpdate(self.loss, tau=recipe.tau)
        groups: list[dict[str, Any]] = [
            {"params": list(self.policy.network.parameters())},
            {"params": list(self.loss.qvalue_network_params.flatten_keys().values())},
            {"params": [self.loss.log_alpha], "lr": recipe.temperature_rate},
        ]
        self.adam = torch.optim.Adam(groups)

    def enter(self, phase: Phase) -> None:
        self.loss.make_value_estimator(ValueEstimators.TD0, gamma=phase.gamma)
        self.gap = phase.gap

    def aim(self, entropy: float) -> None:
        """Set the target entropy."""
        self.loss.target_entropy.fill_(entropy)

    def update(self, sample: TensorDictBase, rate: float) -> None:
        true = sample.copy().set("observation", sample["truth"])
        if self.gap > 0:
            true["next", "reward"] -= self.gap * self._disadvantage(true)
        value, _ = self.loss.qvalue_loss(true)
        actor = self.hooks.loss(self.policy, sample, self._actor_loss)
        loss = value.mean() + actor.mean() + self.loss.alpha_loss(self.log_prob).mean()
        self.adam.zero_grad()
        loss.backward()
        for group in self.adam.param_groups[:2]:
            group["lr"] = rate
            torch.nn.utils.clip_grad_norm_(group["params"], LONGEST)
        self.adam.step()
        self.target.step()

    def inform(self) -> None:
        """Give the policy the critics and the temperature of the training."""
        self.policy.temperature.copy_(self.loss.log_alpha.exp())
        for number, critic in enumerate(self.policy.critics):
            copy_weights(self.loss.qvalue_network_params[number], _critic(critic))

    def average(self, policy: SoftPolicy) -> None:
        """Copy the averaged weights into another policy."""
        copy_weights(self.loss.target_actor_network_params, self._actor(policy))
        for number, critic in enumerate(policy.critics):
            copy_weights(self.loss.target_qvalue_network_params[number], _critic(critic))

    def _actor_loss(self, sample: TensorDictBase) -> Tensor:
        loss, found = self.loss.actor_loss(sample)
        self.log_prob: Tensor = found["log_prob"]
        return loss.flatten()

    @torch.no_grad()
    def _disadvantage(self, sample: TensorDictBase) -> Tensor:
        """max_a Q(s, a) - Q(s, a) [N, 1] of the policy's critics, as in `dqn` (Bellemare et al. 2016, Eq. 6)."""
        values = self.policy.values(sample["observation"])
        if self.mask is not None:
            values = values.masked_fill(~sample[self.mask], -torch.inf)
        return values.amax(-1, keepdim=True) - values.gather(-1, sample["action"].unsqueeze(-1))

    def _actor(self, policy: SoftPolicy) -> ProbabilisticTensorDictSequential:
        read = ["observation"] if self.mask is None else ["observation", self.mask]
        return ProbabilisticTensorDictSequential(
            TensorDictModule(Logits(policy.network), in_keys=read, out_keys=["logits"]),
            ProbabilisticTensorDictModule(
                in_keys=["logits"],
                out_keys=["action"],
                distribution_class=torch.distributions.Categorical,
                distribution_kwargs={"validate_args": False},
            ),
        )


def _critic(critic: nn.Module) -> TensorDictModule:
    return TensorDictModule(critic, in_keys=["observation"], out_keys=["action_value"])


def _fused(critics: nn.ModuleList) -> list[Fused]:
    return [cast(QNetwork, critic).fused for critic in critics]
