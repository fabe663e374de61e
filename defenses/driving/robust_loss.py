"""The base of defences that train the victim on the worst point of each observation's perturbation set."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Annotated, ClassVar

import torch
from annotated_types import Interval
from tensordict import TensorDictBase
from torch import Tensor

from cavbench import zoo
from cavbench.core.contracts import Progress, Trained
from cavbench.core.ranges import Count, NotNegative
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
from cavbench.driving.access import Enforcer
from cavbench.driving.threat import Norm, project
from cavbench.driving.victim import CountedPolicy
from cavbench.driving.victims.attack_mix import attack_of, attacked
from cavbench.errors import UserError

SCORED = "pgd steps=5 restarts=1"
"""The attack under which checkpoints are scored."""
STEP = 1.5
"""Length of all steps together as a share of the diameter of the set."""

Objective = Callable[[Tensor], Tensor]
"""What is largest at the worst point: observations [N, V, F] to [N], with a gradient."""
Own = Callable[[TensorDictBase], Tensor]
"""The loss [N] of the victim's algorithm on each transition of a batch."""
Worst = Callable[[Objective], Tensor]
"""Searches the sets around the observations of a batch for the points [N, V, F] with the highest objective."""


@dataclass(frozen=True, kw_only=True)
class RobustLoss(DrivingDefense):
    """Continues the victim's own training, with a loss at the worst points of the observations that it learns from.

    A subclass says what is worst, and what loss that gives. The victim acts on the true observations; nothing is added when it
    drives.

    Args:
        weight: weight of the robust part of the loss; 0 is the control: the same training without it.
        norm: perturbation set of the training, `relative` or `linf`.
        budget: size of this set after the ramp.
        steps: gradient steps to the worst point, from a random one.
        decisions: length of the training, on every road at once.
        ramp_to: share of the training at which the budget, which grows from 0, reaches `budget`.
        trained_in: non-default parameters of the training world, for instance `vehicles=5`; set by `bench train`.
    """

    name: ClassVar[str]
    """The name of its entries in the zoo."""

    weight: NotNegative = 1.0
    norm: Norm = "relative"
    budget: Annotated[float, Interval(ge=0, le=2)] = 0.1
    steps: Count = 2
    decisions: Count = 8_000
    ramp_to: Annotated[float, Interval(gt=0, le=1)] = 0.3
    trained_in: str = ""

    @abstractmethod
    def loss(self, policy: Policy, sample: TensorDictBase, own: Own, worst: Worst) -> Tensor:
        """The loss of a batch of transitions: a number, or [N].

        Args:
            policy: the policy in training.
            sample: transitions [N] with the true `observation` [N, V, F], `action` and `next`.
            own: the victim's own loss.
            worst: the search for worst points.
        """

    def zoo_name(self, victim: DrivingVictim) -> str:
        return f"{victim.zoo_name()}-{self.name}"

    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        if victim.policy_type is None:
            raise UserError(f"{self.name} needs a victim that learns")
        return zoo.load(zoo.Recipe.of(victim, self), seed, victim.policy_type)

    def train(self, victim: DrivingVictim, world: DrivingWorld, *, seed: int, progress: Progress) -> Trained[Policy]:
        """Train on from the victim of the same training seed.

        Raises:
            UserError: if the zoo has no such victim.
        """
        hooks = RobustTraining(self, world.facts, victim.load(seed, world.facts), seed)
        trained = victim.train(world, seed=seed, hooks=hooks, progress=progress)
        return Trained(trained.network, {**trained.card, "threat": asdict(hooks.threat)})


class RobustTraining(TrainingHooks):
    """The training of a `RobustLoss`.

    Args:
        recipe: the defence.
        facts: facts of the world.
        start: the policy to continue from.
        seed: training seed.
    """

    checkpoints = 0.5

    def __init__(self, recipe: RobustLoss, facts: DrivingFacts, start: Policy, seed: int) -> None:
        self.recipe, self.facts = recipe, facts
        self.start, self.decisions = start, recipe.decisions
        self.threat = ObservationThreat(norm=recipe.norm, budget=recipe.budget)
        self.starts, self.noise = (torch.Generator().manual_seed(seed) for _ in range(2))
        self.scale = 0.0

    def replayed(self, observation: Tensor, policy: Policy, share: float) -> Tensor:
        self.scale = min(1.0, share / self.recipe.ramp_to)
        return observation

    def loss(self, policy: Policy, sample: TensorDictBase, own: Own) -> Tensor:
        def worst(objective: Objective) -> Tensor:
            return self.worst(sample["observation"], objective)

        return self.recipe.loss(policy, sample, own, worst) if self.recipe.weight else own(sample)

    def worst(self, observation: Tensor, objective: Objective) -> Tensor:
        """The end [N, V, F] of sign steps to a higher objective, from a random point of each set."""
        radius = self.threat.radius(observation, self.facts.features, self.scale)
        point = torch.rand(observation.shape, generator=self.starts) * 2 - 1
        point = project(observation + point * radius, observation, radius)
        for _ in range(self.recipe.steps):
            point.requires_grad_()
            (gradient,) = torch.autograd.grad(objective(point).sum(), point)
            step = 2 * STEP / self.recipe.steps * radius * gradient.sign()
            point = project(point.detach() + step, observation, radius)
        return point

    def selection(self, policy: Policy) -> dict[str, Callable[[Tensor, State], Tensor]]:
        attack = attack_of(SCORED)

        def shown(observation: Tensor, state: State) -> Tensor:
            enforcer = Enforcer(CountedPolicy(policy), self.threat, attack.access, self.facts.features, self.noise)
            return attacked(attack, enforcer, observation, state)[0]

        return {"attacked": shown}
