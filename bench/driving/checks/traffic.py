"""Random observations and victims with random weights, for the checks of the driving track."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from cavbench.checks.check import Subject
from cavbench.checks.scenarios import first_cell
from cavbench.driving import ActionType, DrivingAttack, DrivingFacts, DrivingWorld, Features, Policy
from cavbench.driving.traffic import View

HIDDEN = 16
FAR, ROAD = 1000.0, 3.0
"""Where absent cars are, in m behind, and the lanes of the road."""


def observations(count: int, *, features: Features, rows: int = 10, seed: int = 0) -> Tensor:
    """Random observations [count, rows, F]; some rows are absent, but never that of the ego."""
    generator = torch.Generator().manual_seed(seed)
    measured = torch.rand(count, rows, len(features.names), generator=generator) * 2 - 1
    present = (torch.rand(count, rows, 1, generator=generator) > 0.3).float()
    present[:, 0] = 1.0
    return torch.cat((present, measured * present), -1)


def viewed(attack: DrivingAttack, observation: Tensor, features: Features) -> View | None:
    """The traffic of observations [B, V, F] for an attack that drives some of it; None for other attacks."""
    if not attack.drives:
        return None
    place = {name: number for number, name in enumerate(features.names)}
    cars = features.physical(observation).double()
    x, y, vx = (cars[..., place[name]] for name in ("x", "y", "vx"))
    absent = (observation[..., 0] <= 0).double()
    ones = torch.ones_like(x)
    # An absent car is far away; the first row is the victim's own, in absolute values.
    along = (x * (1 - absent) - FAR * absent).index_fill(1, torch.tensor([0]), 0.0)
    return View(along, y, vx.abs(), 0 * ones, 0 * ones, 0 * ones, ROAD * ones)


def victim(action_type: ActionType, facts: DrivingFacts) -> Policy:
    """A network as in the zoo, with random weights large enough that its decisions vary.

    Args:
        action_type: action type of the network.
        facts: facts of the world, with its features and actions.
    """
    from cavbench.driving.victims.networks import ActorPolicy, QPolicy

    width = len(facts.features.names) + 1
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        discrete = action_type == "discrete"
        policy: Policy = QPolicy(width, len(facts.actions), HIDDEN) if discrete else ActorPolicy(width, HIDDEN, 0.5)
    with torch.no_grad():
        for weight in policy.parameters():
            weight.mul_(3.0)
    return policy.requires_grad_(False).eval()


def action_types(attack: Subject) -> Sequence[ActionType]:
    """The action types to check an attack with: all of its own, or that of the victim that its network was trained for."""
    return (attack.victim.action_type,) if attack.victim else attack.component.action_types


def rows_of_observation(world: DrivingWorld) -> int:
    """V, the number of rows in the observations [B, V, F] of a world."""
    env = world.make([first_cell(world)], action_type="discrete" if world.facts.actions else "continuous")
    try:
        return int(env.observation_spec["observation"].shape[-2])
    finally:
        env.close(raise_if_closed=False)
