"""What tests of trainings share: short recipes, and transitions to learn from."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from cavbench.core import registry
from cavbench.defenses.driving.advtrain import AdversarialTraining, AttackInLoop
from cavbench.driving import DrivingWorld
from cavbench.driving.victims.ddpg import DDPG
from cavbench.driving.victims.dqn import DQN
from cavbench.driving.victims.networks import ActorPolicy, QPolicy
from cavbench.driving.victims.ppo import PPO
from cavbench.driving.victims.practice import roads
from cavbench.driving.victims.sac import SAC
from cavbench.driving.victims.training import LearningDriver

SHORT = {"decisions": 160, "copies": 1, "hidden": 8, "batch": 16, "checkpoints": 1}
REPLAYED = SHORT | {"memory": 2000}
VICTIMS = [DQN(**REPLAYED), DDPG(**REPLAYED)]
LEARNERS = [*VICTIMS, PPO(**SHORT, fine_rollout=16), SAC(**REPLAYED)]
NAMES = ["dqn", "ddpg", "ppo", "sac"]


def silent(share: float, text: str) -> None:
    """A progress callback that does nothing."""
    assert 0 <= share <= 1


class Lesson:
    """A teacher, transitions with perturbed observations, and a learner that continues from the teacher."""

    def __init__(self, victim: LearningDriver, world: DrivingWorld) -> None:
        torch.manual_seed(0)
        discrete = victim.action_type == "discrete"
        shape = {"features": 5, "hidden": 8}
        self.victim, self.env = victim, world.make(roads(world, 1), action_type=victim.action_type)
        self.teacher = QPolicy(actions=5, **shape) if discrete else ActorPolicy(steering_limit=0.1, **shape)
        self.truth = torch.rand(64, 10, 5)
        self.shown = (self.truth + 0.3 * torch.randn(self.truth.shape)).clamp(-1, 1)
        action = torch.randint(5, (64,)) if discrete else torch.rand(64, 2) - 0.5
        after = {"observation": self.truth, "reward": torch.zeros(64, 1), "done": torch.zeros(64, 1, dtype=torch.bool)}
        after["terminated"] = after["done"].clone()
        self.sample = TensorDict(
            {"observation": self.shown, "truth": self.truth, "action": action, "next": after}, [64]
        )

    def decided(self, **params: float) -> torch.Tensor:
        """The learner's decisions on the perturbed observations after 150 updates: softmax probabilities, or the action."""
        defense = AdversarialTraining(**{"consistency": 0.0, "margin": 0.0, **params})
        facts = registry.load("world", "highway")().facts
        hooks = AttackInLoop(defense, [registry.load("attack", "none")()], facts, self.teacher, seed=0)
        learner = self.victim.learner(self.env, hooks)
        learner.enter(self.victim.phases(hooks)[0])
        for _ in range(150):
            learner.update(self.sample.clone(), 3e-3)
        learner.anneal()
        trained = learner.policy if self.victim.action_type == "discrete" else learner.averaged()
        return self.decision(trained.scores(self.shown).detach())

    def decision(self, scores: torch.Tensor) -> torch.Tensor:
        """Softmax probabilities of scores, on the teacher's scale; continuous actions are returned unchanged."""
        if self.victim.action_type == "continuous":
            return scores
        return torch.softmax(scores / (0.5 * self.teacher.scores(self.truth).std(-1, keepdim=True)), -1).detach()
