"""Training behind a defence: the policy in training receives what the defence passes on, and may do what is left to it."""

from __future__ import annotations

import copy
import shlex
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from bench.driving import (
    DrivingAttack,
    DrivingFacts,
    DrivingVictim,
    ObservationThreat,
    Policy,
    State,
    TrainingHooks,
)
from bench.driving.enforcer import Enforcer
from bench.driving.policy import rows_of
from bench.driving.victim import CountedPolicy
from bench.errors import UserError
from bench.plugins.contracts import Defense
from bench.plugins.options import configured, parameter_words
from bench.victims.drivers.practice import ALLOWED, Practice

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


def defense_of(text: str) -> Defense:
    """The defence in a text such as `tracker+shield shield.band=6`.

    Raises:
        UserError: if there is no such defence, it is for another track, or it trains its victim.
    """
    name, *options = shlex.split(text) or [""]
    defense: Defense = configured("defense", name, parameter_words(" ".join(options))).component
    if not defense.serves("driving"):
        raise UserError(f"a driver cannot be trained behind {name!r}, which is for another track")
    if defense.trains:
        raise UserError(f"a driver is trained behind defences that work at run time, {name!r} trains its victim")
    return defense


class Guard:
    """A defence around the network in training.

    Args:
        defense: the defence.
        victim: the victim in training.
        facts: facts of the world.

    Raises:
        UserError: if the defence does not fit the victim, or does not say what it passes on.
    """

    def __init__(self, defense: Defense, victim: DrivingVictim, facts: DrivingFacts) -> None:
        self.defense, self.victim, self.facts = defense, victim, facts

    def around(self, network: Policy) -> Policy:
        """The network behind the defence; it keeps its mode and its gradients."""
        other, mode = copy.copy(self.victim), network.training
        object.__setattr__(other, "load", lambda seed, facts: network)
        return self.defense.load(other, 0, self.facts).train(mode)


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
        """The attacked observations [N, V, F], and what the attack remembers; with no memory it begins anew."""
        enforcer = Enforcer(CountedPolicy(policy), self.threat, attack.access, self.facts.features, self.noise)
        oracle = enforcer.begin(observation, state)
        memory = attack.initial(observation, oracle) if memory is None else memory
        shown, memory = attack.step(observation, oracle, memory)
        return enforcer.project(shown)[0], memory


def attack_of(words: str) -> DrivingAttack:
    """The attack in a text such as `pgd steps=2`."""
    name, _, parameters = words.partition(" ")
    attack: DrivingAttack = configured("attack", name, parameter_words(parameters)).component
    return attack


class GuardedPractice(Practice):
    """Practice behind a defence. Stored observations and actions are the policy's, so the defence is a part of its world.

    Args:
        guard: the defence.
        args, kwargs: as of `Practice`.
    """

    def __init__(self, *args: Any, guard: Guard, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.policy = guard.around(self.learner.policy)
        self.rows = torch.arange(len(self.td))
        self.state = self.policy.initial(self.rows)
        try:
            self._look(self.td["observation"], 0.0)
        except NotImplementedError as error:
            raise UserError(f"a driver cannot be trained behind this defence: {error}") from None

    def decide(self, share: float) -> TensorDict:
        seen = self.seen
        self.td.update(seen)
        self.explore()
        action = self.td["action"]
        step, self.td = self.env.step_and_maybe_reset(self.td.set("action", executed(action, seen)))
        self.state = self.policy.advance(self.shown, step["action"], self.state)
        self._look(step["next", "observation"], share)
        transition = self.transition(step.update({**seen, "action": action, "next": self.seen}))
        done = step["next", "done"].squeeze(-1)
        if bool(done.any()):
            fresh = self.policy.initial(self.rows)
            self.state = fresh if self.state is None else chosen(done, fresh, self.state)
            self._look(self.td["observation"], share)
        return transition

    @torch.no_grad()
    def _look(self, truth: Tensor, share: float) -> None:
        """What the hooks show for the true observations, and what of it reaches the policy."""
        self.shown = self.learner.hooks.acting(truth, self.policy, share, self.state)
        passed = self.policy.passed(self.shown, self.state)
        self.seen = {"observation": passed.observation}
        if passed.allowed is not None:
            self.seen[ALLOWED] = passed.allowed
        elif self.policy.action_type == "discrete":
            self.seen[ALLOWED] = torch.ones(len(truth), int(self.env.action_spec.space.n), dtype=torch.bool)


def executed(action: Tensor, seen: Mapping[str, Tensor]) -> Tensor:
    """The action that is carried out: continuous ones are clipped to what is left."""
    if ALLOWED not in seen or not action.is_floating_point():
        return action
    return action.clamp(seen[ALLOWED][..., 0, :], seen[ALLOWED][..., 1, :])


def chosen(rows: Tensor, fresh: State, state: TensorDictBase) -> State:
    """The state with the `rows` [B] of a fresh one. What a fresh state does not have yet is zero."""
    assert fresh is not None
    result = state.clone()
    for name in state.keys(include_nested=True, leaves_only=True):
        first = fresh.get(name, None)
        result[name][rows] = torch.zeros_like(result[name][rows]) if first is None else first[rows]
    return result
