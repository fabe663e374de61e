"""A policy, an attack and a defence that break a given rule for memories; with `none` they break no rule."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from cavbench.core.contracts import Access
from cavbench.driving import (
    ActionType,
    DrivingAttack,
    DrivingDefense,
    DrivingFacts,
    DrivingVictim,
    Oracle,
    Policy,
    State,
)


class _Mean(Policy):
    """Its scores depend on a running mean of earlier observations."""

    action_type: ActionType = "discrete"

    def __init__(self, rule: str, facts: DrivingFacts) -> None:
        super().__init__()
        self.rule, self.calls, self.kept = rule, 0, None
        width = 1 + len(facts.features.names)
        self.layer = nn.Linear(width, len(facts.actions), bias=False)
        nn.init.normal_(self.layer.weight, generator=torch.Generator().manual_seed(0))
        self.requires_grad_(False).eval()

    def initial(self, episodes: Tensor) -> Any:
        seen = torch.zeros(len(episodes), self.layer.in_features)
        match self.rule:
            case "object" | "no initial":
                return None
            case "dict":
                return {"seen": seen}
            case "batch size":
                return TensorDict({"seen": seen}, batch_size=[])
            case "draws":
                seen = torch.rand(seen.shape)
        return TensorDict({"seen": seen}, batch_size=episodes.shape)

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        if self.rule.startswith("counts"):
            self.calls += 1
        seen: Any = self.kept if self.rule == "object" else state["seen"] if state is not None else None
        now = observation.mean(-2)
        scores = self.layer(now if seen is None else (now + seen) / 2)
        match self.rule:
            case "counts":
                return scores + 0.1 * self.calls
            case "in place":
                seen += 1
            case "places":
                return scores + torch.arange(len(observation)).unsqueeze(-1)
        return scores

    def advance(self, observation: Tensor, action: Tensor, state: State) -> Any:
        now = observation.mean(-2)
        if self.rule == "object":
            self.kept = now
            return None
        if self.rule == "forgets":
            return None
        if state is not None and self.rule == "advances in place":
            state["seen"] = (state["seen"] + now) / 2
            return state
        seen = now if state is None else (state["seen"] + now) / 2
        match self.rule:
            case "mixes":
                seen = seen - seen.mean(0)
            case "counts for later":
                seen = seen + self.calls
            case "graph":
                seen = seen.clone().requires_grad_(True)
        return TensorDict({"seen": seen}, batch_size=[len(observation)])


@dataclass(frozen=True, kw_only=True)
class Forgetful(DrivingVictim):
    """A victim with a memory.

    Args:
        rule: that it breaks.
    """

    rule: str = "none"

    @property
    def action_type(self) -> ActionType:
        return "discrete"

    def load(self, seed: int, facts: DrivingFacts) -> Policy:
        return _Mean(self.rule, facts)


@dataclass(frozen=True, kw_only=True)
class Grudge(DrivingAttack):
    """Keeps the perturbation of the first step.

    Args:
        rule: that it breaks.
    """

    access: ClassVar[Access] = "scores"
    kept: ClassVar[dict[str, Tensor]] = {}
    rule: str = "none"

    def initial(self, observation: Tensor, oracle: Oracle) -> Any:
        signs = torch.randint(0, 2, observation.shape, generator=oracle.generator) * 2.0 - 1.0
        match self.rule:
            case "object":
                self.kept["signs"] = signs
                return None
            case "places":
                self.kept["signs"] = observation.sign()
                return None
            case "asks":
                oracle.scores(observation)
            case "no initial":
                return None
            case "dict":
                return {"signs": signs}
        return TensorDict({"signs": signs}, batch_size=[len(observation)])

    def step(self, observation: Tensor, oracle: Oracle, state: State) -> Any:
        signs = torch.ones_like(observation) if state is None else state["signs"]
        if self.rule in ("object", "places"):
            signs = self.kept["signs"][: len(observation)]
        shown = oracle.project(observation + signs * oracle.radius)
        match self.rule:
            case "alone":
                return shown
            case "no initial":
                return shown, TensorDict({"signs": signs}, batch_size=[len(observation)])
            case "forgets":
                return shown, None
            case "grows":
                return shown, TensorDict({"signs": torch.cat((signs, signs), 1)}, batch_size=[len(observation)])
        return shown, state


class _Losing(Policy):
    def __init__(self, policy: Policy, rule: str) -> None:
        super().__init__()
        self.policy, self.rule = policy, rule
        self.action_type, self.weights_sha256 = policy.action_type, policy.weights_sha256

    def initial(self, episodes: Tensor) -> State:
        return None if self.rule == "no initial" else self.policy.initial(episodes)

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        own = state if state is None or self.rule == "none" else self.policy.initial(torch.arange(len(observation)))
        return self.policy.scores(observation, own)

    def advance(self, observation: Tensor, action: Tensor, state: State) -> State:
        return self.policy.advance(observation, action, state)


@dataclass(frozen=True, kw_only=True)
class Losing(DrivingDefense):
    """Passes the victim's memory on, depending on the rule.

    Args:
        rule: that it breaks.
    """

    rule: str = "none"

    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        return _Losing(victim.load(seed, facts), self.rule).eval()
