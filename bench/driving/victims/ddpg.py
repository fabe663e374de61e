"""The DDPG driver: TorchRL's deterministic policy gradient with the three tricks of TD3."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import torch
from annotated_types import Interval
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor
from torchrl.data import Bounded
from torchrl.envs import EnvBase
from torchrl.modules import AdditiveGaussianModule
from torchrl.objectives import SoftUpdate, TD3Loss, ValueEstimators

from cavbench.core.ranges import Count, NotNegative, Width
from cavbench.driving import ActionType, Policy, TrainingHooks
from cavbench.driving.victims.learner import CHUNK, Learner, Phase, copy_weights
from cavbench.driving.victims.networks import Actor, ActorPolicy, Critic
from cavbench.driving.victims.replay import OffPolicyDriver, OffPolicyLearner


@dataclass(frozen=True, kw_only=True)
class DDPG(OffPolicyDriver):
    """A deterministic actor (Lillicrap et al. 2016) with continuous steering and acceleration.

    TorchRL's TD3Loss: twin critics, smoothed target actions and delayed actor updates (Fujimoto et al. 2018) on top of DDPG,
    with n-step returns. Leaving the road ends an episode and has the same penalty as a crash; otherwise the policy learns to
    drive in circles beside the road.

    Args:
        steering_limit: largest |steering| of the actor, as a share of 45 degrees.
        noise: standard deviation of the final exploration noise, as a share of the actor's range.
        actor_delay: critic updates per actor update.
    """

    algorithm = "ddpg"
    policy_type = ActorPolicy

    # Smaller and shorter than for DQN, because training actor and critic in turns takes longer.
    decisions: Count = 24_000
    hidden: Width = 64
    steering_limit: Annotated[float, Interval(gt=0, le=1)] = 0.1
    noise: NotNegative = 0.15
    actor_delay: Count = 2

    @property
    def action_type(self) -> ActionType:
        return "continuous"

    def learner(self, env: EnvBase, hooks: TrainingHooks) -> Learner:
        return _ActorCriticLearner(self, env, hooks)


class _ActorCriticLearner(OffPolicyLearner):
    def __init__(self, recipe: DDPG, env: EnvBase, hooks: TrainingHooks) -> None:
        super().__init__(hooks, memory=recipe.memory, batch=recipe.batch, updates=recipe.updates)
        batch, _, features = env.observation_spec["observation"].shape
        self.policy: ActorPolicy = ActorPolicy(features, recipe.hidden, recipe.steering_limit)
        self.mean = ActorPolicy(features, recipe.hidden, recipe.steering_limit)
        if hooks.start is not None:
            self.policy.load_state_dict(hooks.start.state_dict())
        self.delay, self.steps = recipe.actor_delay, 0
        limit = self.policy.actor.limit
        actor = _actor(self.policy.actor)
        self.noise = AdditiveGaussianModule(
            Bounded(-limit.expand(batch, 2), limit.expand(batch, 2)),
            sigma_init=max(0.4, recipe.noise) if hooks.start is None else recipe.noise,
            sigma_end=recipe.noise,
            annealing_num_steps=math.ceil(0.3 * recipe.decisions / CHUNK),
            std=limit,
        )
        self.explore = TensorDictSequential(actor, self.noise)
        self.loss = TD3Loss(
            actor,
            _critic(self.policy.critic),
            bounds=(-limit, limit),
            policy_noise=0.2 * limit,
            noise_clip=0.5 * limit,
            deactivate_vmap=True,
            reduction="none",
        )
        # The loss trains its own twin critics; the policy's critic is a copy of the first.
        self.policy.critic.requires_grad_(False)
        self.target = SoftUpdate(self.loss, tau=recipe.tau)
        self.actor_adam = torch.optim.Adam(list(self.loss.actor_network_params.flatten_keys().values()))
        self.critic_adam = torch.optim.Adam(list(self.loss.qvalue_network_params.flatten_keys().values()))

    def enter(self, phase: Phase) -> None:
        super().enter(phase)
        # The noise is drawn at every decision and averages out over single frames, so its scale does not change.
        self.loss.make_value_estimator(ValueEstimators.TD0, gamma=phase.gamma)

    def update(self, sample: TensorDictBase, learning_rate: float) -> None:
        self.steps += 1
        value, _ = self.loss.value_loss(sample.copy().set("observation", sample["truth"]))
        _descend(self.critic_adam, value.mean(), learning_rate)
        if self.steps % self.delay == 0:
            loss = self.hooks.loss(self.policy, sample, self._actor_loss)
            _descend(self.actor_adam, loss.mean(), learning_rate)
            self.target.step()

    def _actor_loss(self, sample: TensorDictBase) -> Tensor:
        loss: Tensor = self.loss.actor_loss(sample)[0]
        return loss.flatten()

    def anneal(self) -> None:
        self.noise.step()
        copy_weights(self.loss.qvalue_network_params[0], _critic(self.policy.critic))

    def averaged(self) -> Policy:
        copy_weights(self.loss.target_actor_network_params, _actor(self.mean.actor))
        copy_weights(self.loss.target_qvalue_network_params[0], _critic(self.mean.critic))
        return self.mean


def _actor(actor: Actor) -> TensorDictModule:
    return TensorDictModule(actor, in_keys=["observation"], out_keys=["action"])


def _critic(critic: Critic) -> TensorDictModule:
    return TensorDictModule(critic, in_keys=["observation", "action"], out_keys=["state_action_value"])


def _descend(adam: torch.optim.Adam, loss: Tensor, learning_rate: float) -> None:
    adam.param_groups[0]["lr"] = learning_rate
    adam.zero_grad()
    loss.backward()
    torch.nn.utils.clip_grad_norm_(adam.param_groups[0]["params"], 10.0)
    adam.step()
