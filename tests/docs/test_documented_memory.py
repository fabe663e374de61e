"""The filter with a memory on the page of `frame_stack` is one that works."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict

from cavbench.driving import ObservationFilter, Policy
from cavbench.driving.filter import FilteredPolicy
from cavbench.driving.victims.reference import Blind
from tests.attacks.driving.victims import observations
from tests.driving.policies import FACTS, Echo
from tests.tree import ROOT

PAGE = ROOT / "docs" / "defenses" / "frame_stack.md"


def behind_the_page(policy: Policy) -> FilteredPolicy:
    """The policy behind the filter of the page, with a weight of 0.25."""
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    names: dict[str, Any] = {"ObservationFilter": ObservationFilter, "TensorDict": TensorDict, "dataclass": dataclass}
    exec(code, names)
    return FilteredPolicy(policy, names["MovingAverage"](weight=0.25))


def test_the_page_shows_a_filter_that_remembers() -> None:
    steps = [observations(3, seed) for seed in range(4)]
    policy, expected = behind_the_page(Echo()), steps[0]
    state = policy.initial(torch.arange(3))
    for observation in steps:
        expected = 0.25 * observation + 0.75 * expected
        torch.testing.assert_close(policy.scores(observation, state), expected.flatten(-2))
        state = policy.advance(observation, policy.decide(observation, state), state)


def test_it_carries_the_memory_of_the_victim_behind_it() -> None:
    alone = Blind().load(0, FACTS)
    policy = behind_the_page(alone)
    own, state = alone.initial(torch.arange(3)), policy.initial(torch.arange(3))
    for step in range(70):
        observation = observations(3, step)
        action = alone.decide(observation, own)
        torch.testing.assert_close(policy.decide(observation, state), action)
        own, state = alone.advance(observation, action, own), policy.advance(observation, action, state)
