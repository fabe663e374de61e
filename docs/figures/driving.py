"""Real episodes on the highway, and what an attack asks and shows at one moment of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

from bench.driving import DrivingAttack, ObservationThreat, Policy
from bench.driving.attacker import AttackModule
from bench.driving.drive import drive
from bench.driving.rollout import Columns, Trace
from bench.plugins.pair import choose
from bench.run.config import run_config
from bench.run.plan import plan
from envs.highway.config import STANDARD_FEATURES as FEATURES
from envs.highway.config import HighwayConfig

Array = NDArray[Any]

STEPS_PER_SECOND = HighwayConfig.policy_frequency
ROAD = "lanes=3 density=1 weather=clear seeds=0 reference=false"
"""The cell of the episodes that are shown."""


@cache
def episode(*words: str) -> tuple[Columns, dict[str, Array]]:
    """The measurements and every step [T, ...] of the first episode of a run, said as to `bench run`."""
    trace = Trace([0])
    unit = next(iter(plan(run_config([*ROAD.split(), "episodes=1", *words]))))
    columns = drive(unit, trace)
    running = np.stack(trace.steps["running"])[:, 0]
    return columns, {name: np.stack(steps)[running, 0] for name, steps in trace.steps.items()}


@cache
def policy(victim: str = "dqn", defense: str = "none") -> Policy:
    """The (defended) policy of training seed 0."""
    return choose("defense", defense).component.load(choose("victim", victim).component, 0)


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
    module = AttackModule(attack, policy(), ObservationThreat(), FEATURES, seed=0)
    module.oracle.asked = []
    batch = observation.repeat(trials, 1, 1)
    shown = module(TensorDict({"observation": batch}, batch_size=[trials]))["perturbed"]
    return Moment(observation, shown, module.oracle.radius[0], [points for _, points in module.oracle.asked])


def physical(observation: Tensor) -> Tensor:
    """The measured features [..., F - 1] in m and m/s."""
    centre = (torch.tensor(FEATURES.low) + torch.tensor(FEATURES.high)) / 2
    return observation[..., 1:] * FEATURES.half_range() + centre
