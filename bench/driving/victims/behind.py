"""Training behind a defence: the policy in training receives what the defence passes on, and may do what is left to it."""

from __future__ import annotations

import copy
import shlex
from collections.abc import Mapping
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from cavbench.core.contracts import Defense
from cavbench.core.options import configured, parameter_words
from cavbench.driving import DrivingFacts, DrivingVictim, Policy, State
from cavbench.driving.victims.practice import ALLOWED, Practice
from cavbench.errors import UserError


def defense_of(text: str) -> Defense:
    """The defence in a text such as `tracker+shield shield.band=6`.

    Raises:
        UserError: if there is no such defence, it is for another track, or it trains its victim.
    """
    name, *options = shlex.split(text) or [""]
    defense: Defense = configured("defense", name, parameter_words(" ".join(options))).component
    if not defense.serves("driving"):
        raise UserError(f"a driver cannot be trained behind {name!r}, which is for another track")
    if defense.hardens:
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
        defended = cast(Policy, self.defense.load(other, 0, self.facts))
        defended.train(mode)
        return defended


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
