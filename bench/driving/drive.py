"""The work of a unit of the driving track: one pair at the wheel, on every scenario of a cell."""

from __future__ import annotations

import torch

from bench.driving.rollout import Columns, Trace, rollout
from bench.driving.threat import ObservationThreat
from bench.run.unit import Unit


def drive(unit: Unit, trace: Trace | None = None) -> Columns:
    """Do the work of a unit and return the measurements of its episodes, [B] each (`bench.driving.rollout.rollout`).

    Args:
        unit: what to drive.
        trace: filled with every step of its episodes.
    """
    attack, defense, victim, world = (part.component for part in unit.parts)
    threat = unit.pair.threat
    assert isinstance(threat, ObservationThreat)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(unit.attack_seed)
        policy = defense.load(victim, unit.training_seed)
        cells = [unit.cell] * len(unit.seeds)
        env = world.make(cells, action_type=policy.action_type, driver=policy.driver)
        try:
            return rollout(
                env,
                policy,
                attack,
                threat,
                unit.seeds,
                features=world.features,
                max_steps=world.max_steps,
                attack_seed=unit.attack_seed,
                trace=trace,
            )
        finally:
            env.close(raise_if_closed=False)
