"""Real episodes on the highway, and what an attack asks and shows at one moment of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bench.driving import DrivingAttack, ObservationThreat, Policy
from bench.driving.attacker import Attacker
from bench.driving.drive import drive
from bench.driving.rollout import Trace
from bench.plugins.pair import choose
from bench.plugins.track import Columns, Driven
from bench.run.config import run_config
from bench.run.plan import plan
from envs.highway.world import HighwayWorld

Array = NDArray[Any]

FACTS = HighwayWorld().facts
FEATURES = FACTS.features
ROAD = "lanes=3 density=1 weather=clear seeds=0 reference=false"
"""The cell of the episodes that are shown."""


def scored(episodes: int, *words: str, traced: int = 0) -> Driven:
    """The first episodes of the first pair of a run, said as to `bench run`; the first `traced` of them step by step."""
    unit = next(iter(plan(run_config([*ROAD.split(), f"episodes={episodes}", *words]))))
    return drive(unit.job, unit.seeds[:traced])


@cache
def episode(*words: str) -> tuple[Columns, dict[str, Array]]:
    """The measurements and every step [T, ...] of the first episode of a run, said as to `bench run`."""
    driven = scored(1, *words, traced=1)
    (trace,) = driven.traces.values()
    assert isinstance(trace, Trace)
    running = np.stack(trace.steps["running"])[:, 0]
    return driven.columns, {name: np.stack(steps)[running, 0] for name, steps in trace.steps.items()}


@cache
def policy(victim: str = "dqn", defense: str = "none") -> Policy:
    """The (defended) policy of training seed 0."""
    return choose("defense", defense).component.load(choose("victim", victim).component, 0, FACTS)


@dataclass(frozen=True)
class Moment:
    """One decision under attack.

    Args:
        true: [V, F] what was measured.
        shown: [N, V, F] what the policy is shown, in each of N independent trials.
        radius: [V, F] the largest deviation allowed.
        asked: the points [..., N, V, F] that the attack asked the policy about, question by question.
    """

    true: Tensor
    shown: Tensor
    radius: Tensor
    asked: list[Tensor]


def attacked(attack: DrivingAttack, observation: Tensor, trials: int = 1) -> Moment:
    """What an attack does at one moment [V, F] to the undefended `dqn`, under the default threat model."""
    attacker = Attacker(attack, policy(), ObservationThreat(), FEATURES, seed=0)
    attacker.oracle.asked = []
    shown = attacker.show(observation.repeat(trials, 1, 1), torch.ones(trials, dtype=torch.bool), None).observation
    return Moment(observation, shown, attacker.oracle.radius[0], [points for _, points in attacker.oracle.asked])


def physical(observation: Tensor) -> Tensor:
    """The measured features [..., F - 1] in m and m/s."""
    centre = (torch.tensor(FEATURES.low) + torch.tensor(FEATURES.high)) / 2
    return observation[..., 1:] * FEATURES.half_range() + centre
