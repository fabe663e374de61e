"""The DQN driver: TorchRL's double Q-learning with n-step returns and soft target updates."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torchrl.data import Categorical
from torchrl.envs import EnvBase
from torchrl.modules import EGreedyModule, QValueActor
from torchrl.objectives import DQNLoss, SoftUpdate, ValueEstimators

from bench.driving import ActionType, Policy
from bench.driving.contracts import AttackInLoop
from bench.victims.drivers.networks import QPolicy
from bench.victims.drivers.training import CHUNK, Learner, LearningDriver, Phase, target_state

ACTIONS = 5
CHANGES_LANE = torch.tensor([1.0, 0.0, 1.0, 0.0, 0.0])
"""LANE_LEFT and LANE_RIGHT among them."""
TEMPERATURE = 0.5
"""Of the decisions compared in adversarial training, in standard deviations of the Q-values over the actions."""


@dataclass(frozen=True, kw_only=True)
class DQN(LearningDriver):
    """A deep Q-network (Mnih et al. 2015) that chooses lane changes and target speeds.

    TorchRL's DQNLoss with double Q-learning (van Hasselt et al. 2016), n-step returns, a smooth L1 loss and a Polyak-averaged
    target network, whose weights are also what drives in the end.

    Args:
        final_epsilon: random share of actions from 30 % of the training on, falling linearly from 1 until then.
    """

    policy_type = QPolicy

    final_epsilon: float = 0.02

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.final_epsilon <= 1:
            raise ValueError(f"final_epsilon must be between 0 and 1, got {self.final_epsilon}")

    @property
    def action_type(self) -> ActionType:
        return "discrete"

    def zoo_name(self) -> str:
        return "dqn"

    def learner(self, env: EnvBase, attack: AttackInLoop | None) -> Learner:
        return _QLearner(self, env, attack)


class _QLearner(Learner):
    def __init__(self, recipe: DQN, env: EnvBase, attack: AttackInLoop | None) -> None:
        super().__init__(attack)
        self.recipe, self.gap, self.margin = recipe, 0.0, attack.margin if attack else 0.0
        batch, _, features = env.observation_spec["observation"].shape
        self.policy: QPolicy = QPolicy(features, ACTIONS, recipe.hidden)
        self.mean = QPolicy(features, ACTIONS, recipe.hidden)
        if self.start is not None:
            self.policy.load_state_dict(self.start.state_dict())
        actor = QValueActor(
            self.policy.network, in_keys=["observation"], spec=Categorical(ACTIONS), action_space="categorical"
        )
        self.greedy = EGreedyModule(
            Categorical(ACTIONS, shape=(batch,)),
            eps_init=1.0 if self.start is None else recipe.final_epsilon,
            eps_end=recipe.final_epsilon,
            annealing_num_steps=math.ceil(0.3 * recipe.decisions / CHUNK),
        )
        self.explore = TensorDictSequential(actor, self.greedy)
        self.loss = DQNLoss(actor, loss_function="smooth_l1", double_dqn=True, delay_value=True)
        self.target = SoftUpdate(self.loss, tau=recipe.tau)
        self.adam = torch.optim.Adam(self.policy.parameters(), recipe.learning_rate)

    def enter(self, phase: Phase) -> None:
        self.loss.make_value_estimator(ValueEstimators.TD0, gamma=phase.gamma)
        self.gap = phase.gap
        if phase.exploration < 1:
            self.greedy.eps_end.fill_(self.recipe.final_epsilon * phase.exploration)
            self.greedy.eps.fill_(self.recipe.final_epsilon * phase.exploration)

    def update(self, sample: TensorDictBase, learning_rate: float) -> None:
        if self.gap > 0:
            sample["next", "reward"] -= self.gap * self._disadvantage(sample)
        self.adam.param_groups[0]["lr"] = learning_rate
        self.adam.zero_grad()
        loss = self.loss(sample)["loss"] + self.inconsistency(sample)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.policy.parameters(), 10.0)
        self.adam.step()
        self.target.step()

    @torch.no_grad()
    def _disadvantage(self, sample: TensorDictBase) -> Tensor:
        """V(s) - Q(s, a) [N, 1]: what advantage learning takes from the reward (Bellemare et al. 2016, Eq. 6)."""
        values = self.policy.scores(sample["observation"])
        return values.amax(-1, keepdim=True) - values.gather(-1, sample["action"].unsqueeze(-1))

    def divergence(self, observation: Tensor, wanted: Tensor) -> Tensor:
        """KL divergence of decisions softmax(Q / tau), tau a share of the spread of the values that are wanted."""
        tau = TEMPERATURE * wanted.std(-1, keepdim=True).clamp(min=torch.finfo(wanted.dtype).tiny)
        decided = torch.log_softmax(self.policy.scores(observation) / tau, -1)
        reluctant = torch.softmax((wanted - self.margin * CHANGES_LANE) / tau, -1)
        return torch.nn.functional.kl_div(decided, reluctant, reduction="batchmean")

    def anneal(self) -> None:
        self.greedy.step()

    def averaged(self) -> Policy:
        self.mean.network.load_state_dict(target_state(self.loss.target_value_network_params, self.mean.network))
        return self.mean
