"""The attacks under which a driver is trained behind a defence."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import torch
from torch import Tensor

from cavbench.core.options import configured, parameter_words
from cavbench.driving import DrivingAttack, DrivingFacts, ObservationThreat, Policy, State, TrainingHooks
from cavbench.driving.access import Enforcer
from cavbench.driving.policy import rows_of
from cavbench.driving.victim import CountedPolicy

MIX = {"none": 7, "pessimist": 3, "pessimist outlook=optimist": 3, "bias": 3, "noise": 2, "targeted": 6}
"""The attacks of the training and their weights; the sum is 24."""
TARGETED = "pgd objective=target restarts=1 steps=1 step_size=2 "
TARGETS = {
    "discrete": ("target_action=4", "target_action=3", "target_action=0", "target_action=2"),
    "continuous": (
        "target_acceleration=-1 target_steering=0",
        "target_acceleration=1 target_steering=0",
        "target_acceleration=0 target_steering=-1",
        "target_acceleration=0 target_steering=1",
    ),
}
"""The targets of `targeted`, one at a time. Checkpoints are scored under the first two: slower and faster."""
STRIDE = 5
"""It has no divisor in common with 24, so parallel episodes on the same road meet different attacks."""
REDRAWN = 1 / 100
"""Share of the decisions at which the target changes, and at which an attack with a memory starts anew."""


class AttackMix(TrainingHooks):
    """The training continues from the victim's own weights, under a mix of attacks: each parallel episode has its own.

    Args:
        start: the policy to continue from.
        decisions: length of the training.
        facts: facts of the world.
        seed: training seed.
    """

    off_policy = True
    checkpoints = 0.5

    def __init__(self, start: Policy, decisions: int, facts: DrivingFacts, seed: int) -> None:
        self.start, self.decisions, self.facts = start, decisions, facts
        self.threat = ObservationThreat()
        self.noise = torch.Generator().manual_seed(seed)
        places = [words for words, weight in MIX.items() for _ in range(weight)]
        self.order = [places[STRIDE * place % len(places)] for place in range(len(places))]
        self.attacks = {words: attack_of(words) for words in MIX if words not in ("none", "targeted")}
        self.targeted = [attack_of(TARGETED + target) for target in TARGETS[start.action_type]]
        self.memory: dict[str, State] = {}

    def acting(self, observation: Tensor, policy: Policy, share: float, state: State = None) -> Tensor:
        if float(torch.rand(1, generator=self.noise)) < REDRAWN or not self.memory:
            self.memory = {}
            target = int(torch.randint(len(self.targeted), (1,), generator=self.noise))
            self.attacks["targeted"] = self.targeted[target]
        shown = observation.clone()
        for words, attack in self.attacks.items():
            rows = torch.tensor([row for row in range(len(shown)) if self.order[row % len(self.order)] == words])
            if len(rows):
                memory = self.memory.get(words)
                shown[rows], self.memory[words] = self._perturbed(
                    attack, observation[rows], policy, rows_of(state, rows), memory
                )
        return shown

    def selection(self, policy: Policy) -> dict[str, Callable[[Tensor, State], Tensor]]:
        words = ["pessimist", *(TARGETED + target for target in TARGETS[policy.action_type][:2])]
        return {one: partial(self._scored, attack_of(one), policy) for one in words}

    def ranked(self, scores: Mapping[str, float]) -> float:
        """The mean of the score without an attack and of the lowest one of all."""
        return (scores["clean"] + min(scores.values())) / 2

    def _scored(self, attack: DrivingAttack, policy: Policy, observation: Tensor, state: State) -> Tensor:
        return self._perturbed(attack, observation, policy, state, None)[0]

    def _perturbed(
        self, attack: DrivingAttack, observation: Tensor, policy: Policy, state: State, memory: State
    ) -> tuple[Tensor, State]:
        enforcer = Enforcer(CountedPolicy(policy), self.threat, attack.access, self.facts.features, self.noise)
        return attacked(attack, enforcer, observation, state, memory)


def attacked(
    attack: DrivingAttack, enforcer: Enforcer, observation: Tensor, state: State, memory: State = None
) -> tuple[Tensor, State]:
    """The attacked observations [N, V, F], and what the attack remembers; with no memory it begins anew."""
    oracle = enforcer.begin(observation, state)
    memory = attack.initial(observation, oracle) if memory is None else memory
    shown, memory = attack.step(observation, oracle, memory)
    return enforcer.project(shown)[0], memory


def attack_of(words: str) -> DrivingAttack:
    """The attack in a text such as `pgd steps=2`."""
    name, _, parameters = words.partition(" ")
    attack: DrivingAttack = configured("attack", name, parameter_words(parameters)).component
    return attack
