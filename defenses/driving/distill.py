"""Defensive distillation: a new network learns the softened decisions of the victim, at a point or throughout its set."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor

from cavbench import zoo
from cavbench.core.contracts import Progress, Trained
from cavbench.core.ranges import Count, NotNegative
from cavbench.driving import DrivingDefense, DrivingFacts, DrivingVictim, DrivingWorld, Policy, State, TrainingHooks
from cavbench.driving.policy import PolicyWrapper
from cavbench.driving.victims.networks import QPolicy
from cavbench.errors import UserError

SHARPNESS = 200.0
"""The teacher's logits are its scores in standard deviations over the actions, times this: at temperature 1 nearly hard."""
FRESH = 1_000_003
"""Added to the training seed for the student's first weights, which are then not those that the teacher's training began with."""


@dataclass(frozen=True, kw_only=True)
class Distillation(DrivingDefense):
    """Trains a new network on the softened decisions of the victim (Papernot et al. 2016; Rusu et al. 2016, arXiv 1511.06295).

    The papers are "Distillation as a Defense to Adversarial Perturbations against Deep Neural Networks" (arXiv 1511.04508) and
    "Policy Distillation". The teacher's scores in standard deviations take the place of its logits; the student has the same
    shape, begins with fresh weights, and drives in the training itself. `temperature=0` is the control: the same training on
    the teacher's decisions alone. For discrete actions.

    Args:
        temperature: the papers' T; both softmaxes are divided by it in training. 0: hard labels, and the student's logits as
            they are.
        answers: what an attack is told: `logits`, or `probabilities` at temperature 1, as the first paper's network answers.
            Their gradients vanish, which only looks like robustness (Carlini and Wagner 2017, arXiv 1608.04644). The decisions
            are the same.
        decisions: length of the training, on every road at once.
        trained_in: non-default parameters of the training world, for instance `vehicles=5`; set by `bench train`.
    """

    temperature: NotNegative = 20.0
    answers: Literal["logits", "probabilities"] = "logits"
    decisions: Count = 8_000
    trained_in: str = ""

    def zoo_name(self, victim: DrivingVictim) -> str:
        return f"{victim.zoo_name()}-distill"

    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        if victim.policy_type is None:
            raise UserError("distill needs a victim that learns")
        # Of the same network, so of the same recipe.
        student = zoo.load(zoo.Recipe.of(victim, replace(self, answers="logits")), seed, victim.policy_type)
        return student if self.answers == "logits" else Probabilities(student).eval()

    def train(self, victim: DrivingVictim, world: DrivingWorld, *, seed: int, progress: Progress) -> Trained[Policy]:
        """Train the student of the victim of the same training seed.

        Raises:
            UserError: if the victim's actions are continuous, it is more than one network, the zoo has none, or `answers` is
                not the default.
        """
        if victim.action_type != "discrete":
            raise UserError(f"distill needs a victim with discrete actions, those of this one are {victim.action_type}")
        if self.answers != "logits":
            raise UserError("defense.answers does not change the training: leave it out, and give it to bench run")
        teacher = victim.load(seed, world.facts)
        if type(teacher) is not QPolicy:
            raise UserError("distill needs a victim that is one network, such as dqn or ppo")
        return victim.train(world, seed=seed, hooks=Lessons(self, teacher, seed), progress=progress)


class Lessons(TrainingHooks):
    """The training of a student: fresh weights, which learn the teacher's decisions where the student itself drives.

    Args:
        recipe: the defence.
        teacher: the victim.
        seed: training seed.
    """

    checkpoints = 0.5

    def __init__(self, recipe: Distillation, teacher: QPolicy, seed: int) -> None:
        self.teacher, self.temperature, self.decisions = teacher, recipe.temperature, recipe.decisions
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed + FRESH)
            student = QPolicy(**teacher.shape)
        # Its softmax begins as soft as that of a student at temperature 1.
        student.network.head[-1].weight.data.mul_(self.temperature or 1.0)
        self.start: Policy = student

    def loss(self, policy: Policy, sample: TensorDictBase, own: Callable[[TensorDictBase], Tensor]) -> Tensor:
        """The cross-entropy [N] of the labels and the student's probabilities; the victim's own loss does not count."""
        with torch.no_grad():
            wanted = labels(self.teacher.scores(sample["observation"]), self.temperature)
        logits = policy.scores(sample["observation"]) / (self.temperature or 1.0)
        return -(wanted * logits.log_softmax(-1)).sum(-1)


def labels(scores: Tensor, temperature: float) -> Tensor:
    """The teacher's probabilities [N, A] at a temperature, from its scores [N, A]; of its greedy action alone at 0."""
    if temperature == 0:
        return torch.nn.functional.one_hot(scores.argmax(-1), scores.shape[-1]).to(scores)
    spread = scores.std(-1, keepdim=True).clamp(min=torch.finfo(scores.dtype).tiny)
    return torch.softmax(SHARPNESS * scores / (spread * temperature), -1)


class Probabilities(PolicyWrapper):
    """A policy that answers with the softmax of its logits at temperature 1."""

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        return self.policy.scores(observation, state).softmax(-1)
