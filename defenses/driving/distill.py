"""Defensive distillation: a new network learns the softened decisions of the victim, at a point or throughout its set."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import torch
from annotated_types import Interval
from tensordict import TensorDictBase
from torch import Tensor

from cavbench import zoo
from cavbench.core.contracts import Progress, Trained
from cavbench.core.ranges import Count, NotNegative, Positive, Share
from cavbench.driving import (
    DrivingDefense,
    DrivingFacts,
    DrivingVictim,
    DrivingWorld,
    ObservationThreat,
    Policy,
    State,
    TrainingHooks,
)
from cavbench.driving.bounds.intervals import leads
from cavbench.driving.features import Features
from cavbench.driving.policy import PolicyWrapper
from cavbench.driving.threat import Norm, bounds
from cavbench.driving.victims.networks import QPolicy
from cavbench.driving.victims.training import LearningDriver
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
        bounds: weight of a bound of the same loss over the perturbation set of each observation, by intervals (IBP, Gowal et al.
            2018, arXiv 1810.12715). `bench certify` can then prove more of the decisions. 0 learns at the observation alone.
        norm: perturbation set of the bound, `relative` or `linf`.
        budget: size of this set after the ramp.
        ramp_to: share of the training at which the budget, which grows from 0, reaches `budget`.
        answers: what an attack is told: `logits`, or `probabilities` at temperature 1, as the first paper's network answers.
            Their gradients nearly vanish, which only looks like robustness (Carlini and Wagner 2017, arXiv 1608.04644). The
            decisions are the same.
        learning_rate: initial rate of Adam; it falls as in the victim's own training.
        decisions: length of the training, on every road at once.
        trained_in: non-default parameters of the training world, for instance `vehicles=5`; set by `bench train`.
    """

    temperature: NotNegative = 20.0
    bounds: Share = 0.0
    norm: Norm = "relative"
    budget: Annotated[float, Interval(ge=0, le=2)] = 0.1
    ramp_to: Annotated[float, Interval(gt=0, le=1)] = 0.5
    answers: Literal["logits", "probabilities"] = "logits"
    learning_rate: Positive = 1e-3
    decisions: Count = 4_000
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
        if not isinstance(victim, LearningDriver) or type(teacher) is not QPolicy:
            raise UserError("distill needs a victim that is one network, such as dqn or ppo")
        # A training that continues begins with half of the rate.
        student = replace(victim, learning_rate=2 * self.learning_rate)
        return student.train(
            world, seed=seed, hooks=Lessons(self, teacher, world.facts.features, seed), progress=progress
        )


class Lessons(TrainingHooks):
    """The training of a student: fresh weights, which learn the teacher's decisions where the student itself drives.

    Args:
        recipe: the defence.
        teacher: the victim.
        features: names and ranges of the measured features.
        seed: training seed.
    """

    checkpoints = 0.5

    def __init__(self, recipe: Distillation, teacher: QPolicy, features: Features, seed: int) -> None:
        self.recipe, self.teacher, self.features = recipe, teacher, features
        self.temperature, self.decisions = recipe.temperature, recipe.decisions
        self.threat, self.scale = ObservationThreat(norm=recipe.norm, budget=recipe.budget), 0.0
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed + FRESH)
            student = QPolicy(**teacher.shape)
        # Its softmax begins as soft as that of a student at temperature 1.
        student.network.head[-1].weight.data.mul_(self.temperature or 1.0)
        self.start: Policy = student

    def replayed(self, observation: Tensor, policy: Policy, share: float) -> Tensor:
        self.scale = min(1.0, share / self.recipe.ramp_to)
        return observation

    def loss(self, policy: Policy, sample: TensorDictBase, own: Callable[[TensorDictBase], Tensor]) -> Tensor:
        """The cross-entropy [N] of the labels and the student's probabilities; the victim's own loss does not count."""
        seen, divisor, weight = sample["observation"], self.temperature or 1.0, self.recipe.bounds
        with torch.no_grad():
            wanted = labels(self.teacher.scores(seen), self.temperature)
        loss = -(wanted * (policy.scores(seen) / divisor).log_softmax(-1)).sum(-1)
        if not weight:
            return loss
        assert isinstance(policy, QPolicy)
        box = bounds(seen, self.threat.radius(seen, self.features, self.scale))
        return (1 - weight) * loss + weight * highest(wanted, leads(policy.network, *box) / divisor)


def highest(wanted: Tensor, lead: Tensor) -> Tensor:
    """An upper bound [N] of the cross-entropy over boxes: sum_a wanted_a log sum_b exp(-lead_ab).

    Args:
        wanted: the labels [N, A].
        lead: lower bounds of logit a - logit b, [N, A, A].
    """
    return (wanted * torch.logsumexp(-lead, -1)).sum(-1)


def labels(scores: Tensor, temperature: float) -> Tensor:
    """The teacher's probabilities [N, A] at a temperature, from its scores [N, A]; of its greedy action alone at 0."""
    if temperature == 0:
        return torch.nn.functional.one_hot(scores.argmax(-1), scores.shape[-1]).to(scores)
    spread = scores.std(-1, keepdim=True)
    # Scores that are all the same have none: every action is as good.
    spread = spread.where(spread > torch.finfo(scores.dtype).tiny, 1.0)
    return torch.softmax(SHARPNESS * scores / (spread * temperature), -1)


class Probabilities(PolicyWrapper):
    """A policy that answers with the softmax of its logits at temperature 1."""

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        return self.policy.scores(observation, state).softmax(-1)
