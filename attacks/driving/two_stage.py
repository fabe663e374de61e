"""The two-stage attack: a driver that wants to crash, and targeted PGD that makes the victim drive like it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from cavbench import zoo
from cavbench.attacks.driving.directed import Directed
from cavbench.attacks.driving.director_training import AdversaryWorld
from cavbench.core.contracts import Progress, Trained
from cavbench.core.ranges import Count
from cavbench.driving import DrivingDefense, DrivingFacts, DrivingVictim, DrivingWorld, Policy
from cavbench.driving.victims.networks import QPolicy


@dataclass(frozen=True, kw_only=True)
class TwoStage(Directed):
    """A policy trained to crash chooses the action that PGD makes the victim take (Qu et al. 2021, arXiv 2106.15860).

    Stage one trains a driver whose reward is minus the victim's, at the wheel itself: it knows the roads, but no victim. So it is
    trained once for a world and an action type. Stage two induces, at each step, the best of its actions that can be induced.
    """

    adapts: ClassVar[bool] = False

    decisions: Count = 600

    def zoo_name(self, victim: DrivingVictim) -> str:
        return f"two_stage-{victim.action_type}"

    def train(
        self, victim: DrivingVictim, defense: DrivingDefense, world: DrivingWorld, *, seed: int, progress: Progress
    ) -> Trained[Policy]:
        menu = self.targets_of(victim.action_type, len(world.facts.actions))
        return self.direct(AdversaryWorld(world, victim.action_type, menu.count, menu), seed=seed, progress=progress)

    def load(self, victim: DrivingVictim, defense: DrivingDefense, seed: int, facts: DrivingFacts) -> Policy:
        return zoo.load(zoo.Recipe.of(victim, defense, self), seed, QPolicy)
