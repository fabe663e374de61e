"""PA-AD: a director learns which action to induce in this victim; targeted PGD is the actor that induces it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Interval
from torch import Tensor

from cavbench import zoo
from cavbench.attacks.driving.directed import Directed
from cavbench.attacks.driving.director_training import AdversaryWorld, Victim
from cavbench.attacks.driving.objectives import DiscreteLoss
from cavbench.attacks.driving.pgd import PGD
from cavbench.attacks.driving.targets import EveryActionAndWorst, Targets
from cavbench.core.contracts import Progress, Trained
from cavbench.core.ranges import Count, Natural
from cavbench.driving import (
    DrivingDefense,
    DrivingFacts,
    DrivingVictim,
    DrivingWorld,
    ObservationThreat,
    Oracle,
    Policy,
)
from cavbench.driving.threat import Norm
from cavbench.driving.victims.networks import QPolicy


@dataclass(frozen=True, kw_only=True)
class PAAD(Directed):
    """A learned policy chooses the action that PGD makes the victim take (Sun et al. 2022, PA-AD, arXiv 2106.05087).

    The director is trained with the victim in the loop: it sees the true observation and chooses a target, PGD of a few steps
    tries to induce it, the victim drives, and the director's reward is minus the driver's. So it learns what can be induced in
    this victim, and when. It chooses a single target, not a distribution as in the paper.

    Args:
        training_steps: gradient steps of the actor in training.
        norm: perturbation set in training, `relative` or `linf`.
        budget: its size.
        braking_action: index of the braking action, which the last target spares.
    """

    training_steps: Count = 2
    norm: Norm = "relative"
    budget: Annotated[float, Interval(ge=0, le=2)] = 0.1
    braking_action: Natural = 4

    def zoo_name(self, victim: DrivingVictim) -> str:
        return "paad"

    def targets_now(self, observation: Tensor, oracle: Oracle, count: int) -> Targets:
        if oracle.action_type == "continuous":
            return self.targets_of("continuous", count)
        return EveryActionAndWorst(
            DiscreteLoss(
                objective="collision",
                clean=oracle.scores(observation),
                temperature=0.5,
                target_action=0,
                braking_action=self.braking_action,
            )
        )

    def train(
        self, victim: DrivingVictim, defense: DrivingDefense, world: DrivingWorld, *, seed: int, progress: Progress
    ) -> Trained[Policy]:
        discrete = victim.action_type == "discrete"
        count = len(world.facts.actions) + 1 if discrete else self.targets_of("continuous", 0).count
        actor = PGD(steps=self.training_steps, restarts=1, random_start=False)

        def induce(observation: Tensor, oracle: Oracle, target: Tensor) -> Tensor:
            menu = self.targets_now(observation, oracle, count)
            return actor.descend(observation, oracle, lambda scores: menu.loss(scores, target), lambda _, loss: loss)

        policy = defense.load(victim, seed, world.facts)
        attacked = Victim(policy, ObservationThreat(norm=self.norm, budget=self.budget), induce, seed)
        trained = self.direct(AdversaryWorld(world, victim.action_type, count, attacked), seed=seed, progress=progress)
        return Trained(trained.network, {**trained.card, "against": policy.weights_sha256})

    def load(self, victim: DrivingVictim, defense: DrivingDefense, seed: int, facts: DrivingFacts) -> Policy:
        against = defense.load(victim, seed, facts).weights_sha256
        return zoo.load(zoo.Recipe.of(victim, defense, self), seed, QPolicy, against=against)
