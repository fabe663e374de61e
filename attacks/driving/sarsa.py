"""The Robust Sarsa attack: the attacker's own critic of the victim, and PGD that minimises it."""

from __future__ import annotations

import copy
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar

import torch
from annotated_types import Interval
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from cavbench import zoo
from cavbench.attacks.driving.objectives import TIE_BREAK, expected, taken, temperature
from cavbench.attacks.driving.pgd import PGD
from cavbench.core.contracts import Access, Progress, Trained
from cavbench.core.ranges import Count, NotNegative, Positive, Share, Width
from cavbench.driving import (
    ActionType,
    DrivingAttack,
    DrivingDefense,
    DrivingFacts,
    DrivingVictim,
    DrivingWorld,
    Policy,
    TrainingHooks,
)
from cavbench.driving.victims.learner import CHUNK, Phase
from cavbench.driving.victims.networks import Critic, QNetwork
from cavbench.driving.victims.practice import Practice, roads
from cavbench.driving.victims.replay import OffPolicyLearner
from cavbench.driving.victims.training import WARM_UP
from cavbench.errors import UserError
from cavbench.scenarios import SeedBlock

if TYPE_CHECKING:
    from cavbench.driving import Oracle


class Value(nn.Module):
    """Q(s, a) [...] of a victim, for discrete actions int64 [...] or continuous ones [..., 2].

    Args:
        features: F, size of an observation row.
        actions: number of discrete actions; 0 for continuous ones.
        hidden: width of the two hidden layers.
        steering: unit of the continuous steering.
    """

    weights_sha256 = ""

    def __init__(self, features: int, actions: int, hidden: int, steering: float) -> None:
        super().__init__()
        self.shape = {"features": features, "actions": actions, "hidden": hidden, "steering": steering}
        limit = torch.tensor([1.0, steering])
        self.network = QNetwork(features, actions, hidden) if actions else Critic(features, hidden, limit)

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        if isinstance(self.network, QNetwork):
            return self.network(observation).gather(-1, action.unsqueeze(-1)).squeeze(-1)
        return self.network(observation, action).squeeze(-1)

    def every(self, observation: Tensor) -> Tensor:
        """Q(s, a) of all discrete actions, [..., A]."""
        return self.network(observation)


@dataclass(frozen=True, kw_only=True)
class RobustSarsa(DrivingAttack):
    """PGD on a critic that the attacker trains (Zhang et al. 2020, Robust Sarsa, arXiv 2003.08938, section 4).

    The critic Q(s, a) of the defended victim is learned from its own driving, with exploration, and bootstraps with the action
    that the victim takes in the next state. PGD minimises Q(s, pi(s')): for a discrete victim, the expectation over the softmax
    of its scores, as the objective `expected` of `pgd`. So the attack needs neither Q-values nor a critic of the victim.

    Args:
        steps: gradient steps per restart.
        restarts: independent starts.
        step_size: length of a step as a share of the radius.
        temperature: temperature of the softmax, as a share of the spread of the critic's values, above 0.
        decisions: length of the training in decisions on every road, each held for `repeat` frames.
        repeat: number of frames for which a decision is held in the training.
        exploration: share of random actions in the training; for continuous actions, the standard deviation of the noise.
        robustness: weight of the regulariser (continuous actions): the largest squared change of Q for actions within `around`.
        around: radius of the regulariser, as a share of the action range.
        hidden: width of the critic's hidden layers.
        steering: unit of the steering of a continuous victim.
        gamma: discount per decision of the training.
        crash_penalty: cost of a crash or of leaving the road, in frames of perfect driving.
        updates: gradient updates per decision.
        trained_in: non-default parameters of the training world; set by `bench train`.
    """

    access: ClassVar[Access] = "gradients"
    learns: ClassVar[bool] = True
    at_run_time: ClassVar[tuple[str, ...]] = ("steps", "restarts", "step_size", "temperature")

    steps: Count = 10
    restarts: Count = 4
    step_size: Annotated[float, Interval(gt=0, le=2)] = 0.5
    temperature: Positive = 0.5
    decisions: Count = 800
    repeat: Count = 5
    exploration: Share = 0.3
    robustness: NotNegative = 0.1
    around: Positive = 0.3
    hidden: Width = 128
    steering: Annotated[float, Interval(gt=0, le=1)] = 0.1
    gamma: Share = 0.97
    crash_penalty: float = 200.0
    updates: Count = 4
    trained_in: str = ""

    def zoo_name(self, victim: DrivingVictim) -> str:
        return "sarsa"

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        critic = self.adversary
        assert isinstance(critic, Value)
        if not len(observation):
            return observation
        truth = observation.float()
        pgd = PGD(steps=self.steps, restarts=self.restarts, step_size=self.step_size)
        if oracle.action_type == "continuous":

            def value(action: Tensor) -> Tensor:
                return critic(truth.expand(*action.shape[:-1], *truth.shape[1:]), action.float()).to(action)

            return pgd.descend(observation, oracle, value, lambda _, loss: loss)
        worth = critic.every(truth).to(observation)
        tau = temperature(worth, self.temperature)

        def key(scores: Tensor, loss: Tensor) -> Tensor:
            return taken(scores, worth) + TIE_BREAK * loss

        return pgd.descend(observation, oracle, lambda scores: expected(scores, worth, tau), key)

    def train(
        self, victim: DrivingVictim, defense: DrivingDefense, world: DrivingWorld, *, seed: int, progress: Progress
    ) -> Trained[Value]:
        """Train the critic.

        Raises:
            UserError: if the defended victim has a memory: the critic would need it, too.
        """
        torch.manual_seed(seed)
        started = time.process_time()
        policy = defense.load(victim, seed, world.facts)
        if policy.initial(torch.arange(1)) is not None:
            raise UserError("the critic of this attack knows no memory, and the defended victim has one")
        phase = Phase(self.repeat, self.decisions, self.gamma)
        env = world.make(roads(world, 24), action_type=victim.action_type, action_repeat=self.repeat)
        env.set_seed(SeedBlock.TRAIN * (seed + 1))
        learner = _SarsaLearner(self, policy, victim.action_type, env)
        learner.enter(phase)
        practice = Practice(env, learner, phase, crash_penalty=self.crash_penalty)
        for done in range(CHUNK, self.decisions + 1, CHUNK):
            share = done / self.decisions
            practice.drive(CHUNK, share)
            if done > WARM_UP:
                learner.learn(5e-4 * max(0.05, min(1.0, 2 * (1 - share))), share)
            progress(share, f"loss {learner.last:.4f}")
        card = {"against": policy.weights_sha256, "loss": learner.last}
        critic = learner.mean.requires_grad_(False).eval()
        return Trained(critic, {**card, "cpu_seconds": round(time.process_time() - started, 1)})

    def load(self, victim: DrivingVictim, defense: DrivingDefense, seed: int, facts: DrivingFacts) -> Value:
        against = defense.load(victim, seed, facts).weights_sha256
        return zoo.load(zoo.Recipe.of(victim, defense, self), seed, Value, against=against)


class _SarsaLearner(OffPolicyLearner):
    """Sarsa with the robustness regulariser; the victim does not change."""

    def __init__(self, recipe: RobustSarsa, policy: Policy, action_type: ActionType, env: EnvBase) -> None:
        super().__init__(TrainingHooks(), memory=600_000, batch=512, updates=recipe.updates)
        self.recipe, self.policy, self.gamma, self.last = recipe, policy, recipe.gamma, 0.0
        actions = int(env.action_spec.space.n) if action_type == "discrete" else 0
        features = env.observation_spec["observation"].shape[-1]
        self.critic = Value(features, actions, recipe.hidden, recipe.steering)
        self.mean = copy.deepcopy(self.critic)
        self.adam = torch.optim.Adam(self.critic.parameters())
        self.unit = torch.tensor([1.0, recipe.steering])
        self.explore = _Exploring(policy, actions, recipe.exploration, self.unit)

    def enter(self, phase: Phase) -> None:
        super().enter(phase)
        self.gamma = phase.gamma

    def update(self, sample: TensorDictBase, learning_rate: float) -> None:
        after, seen, action = sample["next"], sample["observation"], sample["action"]
        with torch.no_grad():
            later = self.mean(after["observation"], self.policy.decide(after["observation"]))
            alive = ~after["terminated"].squeeze(-1)
            target = after["reward"].squeeze(-1) + self.gamma * alive * later
        value = self.critic(seen, action)
        loss = nn.functional.smooth_l1_loss(value, target)
        if action.is_floating_point() and self.recipe.robustness > 0:
            loss = loss + self.recipe.robustness * self._sensitivity(seen, action, value)
        self.adam.param_groups[0]["lr"] = learning_rate
        self.adam.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.critic.parameters(), 10.0)
        self.adam.step()
        self.last = float(loss.detach())
        with torch.no_grad():
            for slow, fast in zip(self.mean.parameters(), self.critic.parameters(), strict=True):
                slow.lerp_(fast, 0.005)

    def _sensitivity(self, seen: Tensor, action: Tensor, value: Tensor) -> Tensor:
        """The mean over the batch of max (Q(s, a') - Q(s, a))^2 over |a' - a| <= around, by one sign step from a random start."""
        reach = self.recipe.around * self.unit
        near = (action + reach * (torch.rand_like(action) * 2 - 1)).requires_grad_(True)
        change = (self.critic(seen, near) - value.detach()).square().sum()
        (gradient,) = torch.autograd.grad(change, near)
        worst = (near.detach() + reach * gradient.sign()).clamp(action - reach, action + reach)
        return (self.critic(seen, worst) - value).square().mean()

    def anneal(self) -> None:
        """The exploration is constant."""

    def averaged(self) -> Policy:
        return self.policy


class _Exploring(nn.Module):
    """Writes the victim's `action`, with random deviations, into a tensordict with `observation`."""

    def __init__(self, policy: Policy, actions: int, share: float, unit: Tensor) -> None:
        super().__init__()
        self.policy, self.actions, self.share, self.unit = policy, actions, share, unit

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        action = self.policy.decide(td["observation"])
        if self.actions:
            deviates = torch.rand(action.shape) < self.share
            return td.set("action", torch.where(deviates, torch.randint(self.actions, action.shape), action))
        noisy = action + self.share * self.unit * torch.randn_like(action)
        return td.set("action", noisy.clamp(-self.unit, self.unit))
