"""Episodes on the highway, and the queries and the result of an attack at one moment."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavbench.core.pair import choose
from cavbench.core.track import Columns, Driven
from cavbench.driving import DrivingAttack, ObservationThreat, Policy
from cavbench.driving.attacker import Attacker
from cavbench.driving.drive import drive
from cavbench.driving.rollout import Trace
from cavbench.driving.victim import CountedPolicy
from cavbench.envs.highway.axes import AXES
from cavbench.envs.highway.world import HighwayWorld
from cavbench.run.config import plan_of

Array = NDArray[Any]

WORLD = HighwayWorld()
FACTS = WORLD.facts
FEATURES = FACTS.features
ROAD = "lanes=3 density=1 weather=clear seeds=0 reference=false"
"""Options of the episodes in the figures."""


def scored(episodes: int, *options: str, traced: int = 0) -> Driven:
    """The first episodes of the first pair of a run, by options of `bench run`; the first `traced` of them step by step."""
    unit = next(iter(plan_of([*ROAD.split(), f"episodes={episodes}", *options]).units()))
    return drive(unit.job, unit.seeds[:traced])


@cache
def episode(*options: str) -> tuple[Columns, dict[str, Array]]:
    """The measurements and all steps [T, ...] of the first episode of a run, by options of `bench run`."""
    driven = scored(1, *options, traced=1)
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
        true: measured observation, [V, F].
        shown: observation shown to the policy in each of N independent trials, [N, V, F].
        radius: largest deviation allowed, [V, F].
        asked: points that the attack queried, [..., N, V, F] for each batch of queries.
    """

    true: Tensor
    shown: Tensor
    radius: Tensor
    asked: list[Tensor]


def attacked(attack: DrivingAttack, observation: Tensor, trials: int = 1) -> Moment:
    """Attack the undefended `dqn` at one moment [V, F], under the default threat model."""
    threat = ObservationThreat(access="dynamics")
    moves = WORLD.dynamics([AXES.cell(lanes=3, density=1.0)] * trials, "discrete")
    attacker = Attacker(attack, CountedPolicy(policy()), threat, FEATURES, seed=0, dynamics=moves)
    asked: list[tuple[Tensor | None, Tensor]] = []
    attacker.enforcer.asked = asked
    shown = attacker.show(observation.repeat(trials, 1, 1), torch.ones(trials, dtype=torch.bool), None).observation
    radius = ObservationThreat().radius(observation, FEATURES)
    return Moment(observation, shown, radius, [points for _, points in asked])


def physical(observation: Tensor) -> Tensor:
    """The measured features [..., F - 1] in m and m/s."""
    centre = (torch.tensor(FEATURES.low) + torch.tensor(FEATURES.high)) / 2
    return observation[..., 1:] * FEATURES.half_range() + centre
