"""Adversarial training with a skip probability (thesis, Algorithm 5 and section 4.4.4)."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal

import torch
from torch import Tensor

from bench.driving import DrivingDefense, DrivingFacts, DrivingVictim, DrivingWorld, ObservationThreat, Oracle, Policy
from bench.driving.contracts import AttackInLoop
from bench.driving.threat import Norm
from bench.errors import UserError
from bench.plugins.contracts import Progress, Trained
from bench.plugins.options import configured, parameter_words
from bench.victims import zoo


@dataclass(frozen=True, kw_only=True)
class AdversarialTraining(DrivingDefense):
    """The victim learns while it is attacked (thesis Algorithm 5; Madry et al. 2018 for the principle).

    Each decision of the training is attacked, except that with probability `skip` the victim sees the truth. `skip=1` is the
    control: the same training without an attack.

    Args:
        skip: probability that a decision is not attacked, in [0, 1].
        attack: any registered attack.
        attack_params: its parameters, as on the command line but separated by spaces.
        norm: perturbation set of the attack in the loop, `relative` or `linf`.
        budget: size of that set once the ramp is over.
        start: `trained` goes on from the victim of the same training seed, `scratch` trains a new one.
        decisions: of the further training, on every road at once; with `scratch` it is the victim's own.
        consistency: weight, beside the victim's own loss, of deciding under attack what the victim it started from decides on
            the truth (TRADES, Zhang et al. 2019); 0 is the thesis' algorithm. Nothing to be consistent with from `scratch`.
        margin: what a change of lane must be worth more than anything else, in the values of that policy (1 is perfect driving
            for ever), for consistency to ask for it. One frame's wrong change of lane is a crash, one frame's delay is
            nothing: this is the room between the two that an attack has to cross. Discrete victims only.
        where: `acting` attacks the observations it acts on, which the replay buffer keeps as they were then, as in the thesis;
            `replay` attacks those drawn from the buffer, afresh against the policy as it is now; `both` does both.
        ramp_from: share of the training after which the budget begins to grow from 0.
        ramp_to: share of the training at which it is whole.
    """

    skip: float = 0.3
    attack: str = "pgd"
    attack_params: str = "steps=1 step_size=1 temperature=1"
    norm: Norm = "relative"
    budget: float = 0.1
    start: Literal["trained", "scratch"] = "trained"
    decisions: int = 8_000
    consistency: float = 0.4
    margin: float = 0.02
    where: Literal["acting", "replay", "both"] = "both"
    ramp_from: float = 0.0
    ramp_to: float = 0.3

    def __post_init__(self) -> None:
        if not 0 <= self.skip <= 1:
            raise ValueError(f"skip must be between 0 and 1, got {self.skip}")
        if self.decisions < 1:
            raise ValueError(f"decisions must be at least 1, got {self.decisions}")
        for name in ("consistency", "margin"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must be at least 0, got {getattr(self, name)}")
        if not 0 <= self.ramp_from <= self.ramp_to <= 1:
            raise ValueError(
                f"ramp_from and ramp_to must be in order between 0 and 1, got {self.ramp_from} and {self.ramp_to}"
            )
        ObservationThreat(norm=self.norm, budget=self.budget)

    def zoo_name(self, victim: DrivingVictim) -> str:
        return f"{victim.zoo_name()}-advtrain-{self.attack}-skip{self.skip:g}"

    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        if victim.policy_type is None:
            raise UserError("adversarial training needs a victim that learns")
        made_by = {"victim": asdict(victim), "defense": asdict(self)}  # type: ignore[call-overload]
        return zoo.load(self.zoo_name(victim), seed, victim.policy_type, made_by=made_by)

    def train(self, victim: DrivingVictim, world: DrivingWorld, *, seed: int, progress: Progress) -> Trained[Policy]:
        """Train the hardened policy of training seed `seed`: the victim's own training with the attack in its loop.

        Raises:
            UserError: if the attack does not fit the victim, or `start=trained` and the zoo has no such victim.
        """
        attack = configured("attack", self.attack, parameter_words(self.attack_params)).component
        if victim.action_type not in attack.action_types:
            raise UserError(f"attack {self.attack!r} does not fit a victim with {victim.action_type} actions")
        threat = ObservationThreat(norm=self.norm, budget=self.budget)
        generator = torch.Generator().manual_seed(seed)

        def perturb(observation: Tensor, policy: Policy, scale: float) -> Tensor:
            oracle = Oracle(policy, threat, attack.access, world.features, generator)
            oracle.begin_step(observation, scale=scale)
            return oracle.project(attack.perturb(observation, oracle)).detach()

        loop = AttackInLoop(
            attack=perturb,
            skip=self.skip,
            where=self.where,
            ramp=(self.ramp_from, self.ramp_to),
            start=victim.load(seed, world.facts) if self.start == "trained" else None,
            decisions=self.decisions,
            consistency=self.consistency,
            margin=self.margin,
        )
        trained = victim.train(world, seed=seed, attack=loop, progress=progress)
        made_by = {"defense": asdict(self), "attack": asdict(attack), "threat": asdict(threat)}
        return Trained(trained.network, {**trained.card, **made_by})
