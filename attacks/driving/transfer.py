"""Lies that are made against other policies: the victim is never asked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from annotated_types import Interval

from cavbench.attacks.driving.surrogates import SurrogateAttack, Surrogates
from cavbench.core.contracts import Access, Progress, Trained
from cavbench.core.pair import choose
from cavbench.driving import DrivingDefense, DrivingFacts, DrivingVictim, DrivingWorld, Policy
from cavbench.errors import UserError

BETWEEN = "+"
"""Between the names of surrogates."""
TRAINED = 10
"""Training seeds of each policy of the zoo."""


@dataclass(frozen=True, kw_only=True)
class Transfer(SurrogateAttack):
    """PGD with momentum on other policies of the zoo, shown to a victim that it never asks (Liu et al. 2017, Dong et al. 2018).

    The attack of somebody who knows how such victims are made, but does not have this one: its access is `oblivious`. A victim
    of training seed s is attacked with surrogates of the seeds s + 1, s + 2 ... (of ten, from 0 again after 9), so never with
    itself. Every surrogate is undefended and counts as much as the others. The gradients are summed over the steps (MI-FGSM).

    Distance: the perturbation set of the threat model.

    Args:
        surrogates: names of trained policies, joined by "+" (default dqn).
        seeds: training seeds of each surrogate, 1 to 9 (default 1).
        steps: gradient steps per restart, at least 1 (default 10).
        restarts: independent random starts, at least 1 (default 2).
        step_size: length of a step as a share of the radius, in (0, 2] (default 0.5).
        momentum: decay of the accumulated gradient, in [0, 1]; 1 sums all gradients (default 1).
        objective: the loss of each surrogate, as in `pgd` (default collision).
        temperature: temperature of an expectation, as a share of the spread of the Q-values, above 0 (default 0.5).
        target_action: discrete target, at least 0 (default 3, FASTER).
        target_acceleration: continuous target, in [-1, 1] (default 1).
        target_steering: continuous target, in [-1, 1] (default 0.5).
        braking_action: index of the braking action for `collision`, at least 0 (default 4, SLOWER).

    Shapes: observation [B, V, F] in, the same out. Queries: none.

    Example:
        >>> from cavbench.attacks.driving.transfer import Transfer
        >>> of_three = Transfer(surrogates="dqn+ppo+sac", seeds=1)
    """

    access: ClassVar[Access] = "oblivious"
    joint: ClassVar[bool] = True
    learns: ClassVar[bool] = True
    adapts: ClassVar[bool] = False

    surrogates: str = "dqn"
    seeds: Annotated[int, Interval(ge=1, le=TRAINED - 1)] = 1

    def zoo_name(self, victim: DrivingVictim) -> str:
        return "transfer"

    def train(
        self, victim: DrivingVictim, defense: DrivingDefense, world: DrivingWorld, *, seed: int, progress: Progress
    ) -> Trained[Surrogates]:
        named = self.surrogates.replace(BETWEEN, ",")
        raise UserError(f"attack 'transfer' has nothing to train: its surrogates are victims (victim={named})")

    def load(self, victim: DrivingVictim, defense: DrivingDefense, seed: int, facts: DrivingFacts) -> Surrogates:
        others = [(seed + number) % TRAINED for number in range(1, self.seeds + 1)]
        return Surrogates(
            [self._policy(name, other, facts) for name in self.surrogates.split(BETWEEN) for other in others]
        )

    def _policy(self, name: str, seed: int, facts: DrivingFacts) -> Policy:
        surrogate = choose("victim", name).component
        if not isinstance(surrogate, DrivingVictim) or not surrogate.learns:
            raise UserError(
                f"attack.surrogates={self.surrogates}: {name!r} is no trained driving policy; allowed are dqn, ddpg, ppo and sac"
            )
        return surrogate.load(seed, facts)
