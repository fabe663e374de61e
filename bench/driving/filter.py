"""The commonest defence of a driving policy: a filter between the observation and the policy."""

from __future__ import annotations

import copy
from typing import ClassVar

import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.driving.contracts import DrivingDefense, DrivingVictim
from cavbench.driving.features import DrivingFacts
from cavbench.driving.policy import Passed, Policy, PolicyWrapper, State


class ObservationFilter(DrivingDefense):
    """Changes each observation before the victim sees it. A subclass writes `filter`; with a memory, it writes `step`.

    Both take observations [..., V, F] of any number of episodes, and may not change them in place. Column 0 says whether a row
    is present, the others are measured values in [-1, 1]. What a filter does to an episode must not depend on the others.
    """

    differentiable: ClassVar[bool] = False
    """Whether it has a useful gradient. If not, the gradient passes straight through, as if the filter added a constant
    (BPDA, Athalye et al. 2018, "Obfuscated gradients give a false sense of security"), so that adaptive attacks are possible."""
    facts: DrivingFacts
    """Facts of the world, for instance the units and ranges of the features; set by `load`. It is no parameter."""

    @classmethod
    def missing(cls) -> list[str]:
        neither = cls.filter is ObservationFilter.filter and not cls.remembers()
        return super().missing() + (["filter or step"] if neither else [])

    @classmethod
    def remembers(cls) -> bool:
        """Whether it has a memory."""
        return cls.step is not ObservationFilter.step

    def filter(self, observation: Tensor) -> Tensor:
        """What the victim sees instead of an observation, [..., V, F]."""
        raise NotImplementedError(f"{type(self).__name__} implements neither filter nor step")

    def step(self, observation: Tensor, memory: State) -> tuple[Tensor, State]:
        """What the victim sees, as in `filter`, and the memory for the next observation.

        Args:
            observation: the observation, [..., V, F].
            memory: what is remembered of the same episodes, a TensorDict of batch size [...]; None at the first observation.
        """
        return self.filter(observation), memory

    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        informed = copy.copy(self)
        object.__setattr__(informed, "facts", facts)
        return FilteredPolicy(victim.load(seed, facts), informed).eval()


class FilteredPolicy(PolicyWrapper):
    """A policy behind a filter. Its state is the policy's, beside the filter's memory if it has one.

    Args:
        policy: the policy.
        defense: the filter.
    """

    def __init__(self, policy: Policy, defense: ObservationFilter) -> None:
        super().__init__(policy)
        self.defense = defense

    def initial(self, episodes: Tensor) -> State:
        return self._state(None, self.policy.initial(episodes), episodes.shape)

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        seen, _, inner = self._filtered(observation, state)
        return self.policy.scores(seen, inner)

    def value(self, observation: Tensor, action: Tensor, state: State = None) -> Tensor:
        seen, _, inner = self._filtered(observation, state)
        return self.policy.value(seen, action, inner)

    def advance(self, observation: Tensor, action: Tensor, state: State) -> State:
        seen, memory, inner = self._filtered(observation, state)
        return self._state(memory, self.policy.advance(seen, action, inner), observation.shape[:-2])

    def passed(self, observation: Tensor, state: State = None) -> Passed:
        if self.defense.remembers():
            # Episodes of a training begin at different times, and nobody knows what a memory is before the first observation.
            raise NotImplementedError(f"{type(self.defense).__name__} does not say what it passes on: it has a memory")
        seen, _, inner = self._filtered(observation, state)
        return self.policy.passed(seen, inner)

    def _filtered(self, observation: Tensor, state: State) -> tuple[Tensor, State, State]:
        """What the policy sees, the memory after it, and the policy's state before it."""
        memory, inner = None, state
        if self.defense.remembers():
            assert state is not None
            memory, inner = state.get("memory", None), state.get("policy", None)
        with torch.set_grad_enabled(torch.is_grad_enabled() and self.defense.differentiable):
            seen, memory = self.defense.step(observation, memory)
            # The sum below would repeat a smaller answer, and the policy would see something else than the filter meant.
            if getattr(seen, "shape", None) != observation.shape:
                name, shape = type(self.defense).__name__, tuple(observation.shape)
                raise ValueError(f"the filter {name} must answer observations {shape} with a tensor of that shape")
            if self.defense.differentiable:
                return seen, memory, inner
            change = seen - observation
        return observation + change, memory, inner

    def _state(self, memory: State, inner: State, episodes: torch.Size) -> State:
        if not self.defense.remembers():
            return inner
        parts = {"memory": memory, "policy": inner}
        return TensorDict({name: part for name, part in parts.items() if part is not None}, batch_size=episodes)
