"""The DQN driver: TorchRL's double Q-learning with n-step returns and soft target updates."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import Categorical
from torchrl.envs import EnvBase
from torchrl.modules import EGreedyModule, QValueActor
from torchrl.objectives import DQNLoss, SoftUpdate, ValueEstimators

from cavbench.core.ranges import Share
from cavbench.driving import ActionType, Policy, TrainingHooks
from cavbench.driving.fused.q_learning import Greedy, QLearning, Transitions
from cavbench.driving.victims.learner import CHUNK, Learner, Phase, copy_weights
from cavbench.driving.victims.networks import QPolicy
from cavbench.driving.victims.practice import ALLOWED
from cavbench.driving.victims.replay import Compiled, OffPolicyDriver, OffPolicyLearner

LONGEST = 10.0
"""The norm to which gradients are clipped."""


@dataclass(frozen=True, kw_only=True)
class DQN(OffPolicyDriver):
    """A deep Q-network (Mnih et al. 2015) that chooses lane changes and target speeds.

    TorchRL's DQNLoss with double Q-learning (van Hasselt et al. 2016), n-step returns, a smooth L1 loss and a Polyak-averaged
    target network; the trained policy has the weights of the target network.

    Args:
        final_epsilon: share of random actions after the first 30 % of the training; it falls linearly from 1 until then.
    """

    algorithm = "dqn"
    policy_type = QPolicy

    final_epsilon: Share = 0.02

    @property
    def action_type(self) -> ActionType:
        return "discrete"

    def learner(self, env: EnvBase, hooks: TrainingHooks) -> Learner:
        return _QLearner(self, env, hooks)


class _QLearner(OffPolicyLearner):
    """Drives, and remembers; how it learns is `_Compiled`, or `_Torch` if the hooks change what is learned."""

    def __init__(self, recipe: DQN, env: EnvBase, hooks: TrainingHooks) -> None:
        super().__init__(hooks, memory=recipe.memory, batch=recipe.batch, updates=recipe.updates)
        self.recipe = recipe
        batch, _, features = env.observation_spec["observation"].shape
        actions = int(env.action_spec.space.n)
        self.policy: QPolicy = QPolicy(features, actions, recipe.hidden)
        self.mean = QPolicy(features, actions, recipe.hidden)
        if hooks.start is not None:
            self.policy.load_state_dict(hooks.start.state_dict())
        self.mask = ALLOWED if recipe.behind else None
        self.greedy = EGreedyModule(
            Categorical(actions, shape=(batch,)),
            eps_init=1.0 if hooks.start is None else recipe.final_epsilon,
            eps_end=recipe.final_epsilon,
            annealing_num_steps=math.ceil(0.3 * recipe.decisions / CHUNK),
            action_mask_key=self.mask,
        )
        self.rule: _Compiled | _Torch = (_Torch if hooks.learns_otherwise else _Compiled)(self)
        self.explore = nn.Sequential(self.rule.actor, self.greedy)

    def enter(self, phase: Phase) -> None:
        super().enter(phase)
        self.rule.enter(phase)
        if phase.exploration < 1:
            self.greedy.eps_end.fill_(self.recipe.final_epsilon * phase.exploration)
            self.greedy.eps.fill_(self.recipe.final_epsilon * phase.exploration)

    def update(self, sample: TensorDictBase, learning_rate: float) -> None:
        self.rule.update(sample, learning_rate)

    def anneal(self) -> None:
        self.greedy.step()

    def averaged(self) -> Policy:
        self.rule.average(self.mean)
        return self.mean


class _Compiled(Compiled):
    """The same algorithm as `_Torch` in compiled calls, equal to rounding."""

    def __init__(self, learner: _QLearner) -> None:
        super().__init__(learner.mask)
        self.learning = QLearning(learner.policy.network.fused, tau=learner.recipe.tau, longest=LONGEST)
        self.actor = Greedy(self.learning, learner.mask)

    def enter(self, phase: Phase) -> None:
        self.gamma, self.gap = phase.gamma, phase.gap

    def descend(self, batch: Transitions, rate: float) -> None:
        self.learning.update(batch, gamma=self.gamma, gap=self.gap, rate=rate)

    def average(self, policy: QPolicy) -> None:
        self.learning.averaged(policy.network.fused)


class _Torch:
    """TorchRL's loss, torch's Adam."""

    def __init__(self, learner: _QLearner) -> None:
        self.policy, self.hooks, self.mask = learner.policy, learner.hooks, learner.mask
        self.actor = self._actor(self.policy)
        self.loss = DQNLoss(self.actor, loss_function="smooth_l1", double_dqn=True, delay_value=True, reduction="none")
        self.target = SoftUpdate(self.loss, tau=learner.recipe.tau)
        self.adam = torch.optim.Adam(self.policy.parameters(), learner.recipe.learning_rate)

    def enter(self, phase: Phase) -> None:
        self.loss.make_value_estimator(ValueEstimators.TD0, gamma=phase.gamma)
        self.gap = phase.gap

    def update(self, sample: TensorDictBase, rate: float) -> None:
        if self.gap > 0:
            sample["next", "reward"] -= self.gap * self._disadvantage(sample)
        self.adam.param_groups[0]["lr"] = rate
        self.adam.zero_grad()
        self.hooks.loss(self.policy, sample, self._temporal_difference).mean().backward()
        torch.nn.utils.clip_grad_norm_(self.policy.parameters(), LONGEST)
        self.adam.step()
        self.target.step()

    def average(self, policy: QPolicy) -> None:
        copy_weights(self.loss.target_value_network_params, self._actor(policy))

    def _temporal_difference(self, sample: TensorDictBase) -> Tensor:
        loss: Tensor = self.loss(sample)["loss"]
        return loss.flatten()

    @torch.no_grad()
    def _disadvantage(self, sample: TensorDictBase) -> Tensor:
        """V(s) - Q(s, a) [N, 1], which advantage learning subtracts from the reward (Bellemare et al. 2016, Eq. 6)."""
        values = self.policy.scores(sample["observation"])
        if self.mask is not None:
            values = values.masked_fill(~sample[self.mask], -torch.inf)
        return values.amax(-1, keepdim=True) - values.gather(-1, sample["action"].unsqueeze(-1))

    def _actor(self, policy: QPolicy) -> QValueActor:
        return QValueActor(
            policy.network,
            in_keys=["observation"],
            spec=Categorical(policy.shape["actions"]),
            action_space="categorical",
            action_mask_key=self.mask,
        )
