"""The work of the driving track: drive one pair of attack and defended victim on every scenario of a cell."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from bench.driving.contracts import DrivingAttack, DrivingWorld
from bench.driving.rollout import Trace, rollout
from bench.driving.threat import ObservationThreat
from bench.plugins.track import Driven, Job


def drive(job: Job, traced: Sequence[int]) -> Driven:
    """Drive a job's episodes and return the measurements, [B] each (`bench.driving.rollout.rollout`).

    Args:
        job: the job.
        traced: scenario seeds of the episodes to record.
    """
    pair, world = job.pair, job.pair.world.component
    assert isinstance(world, DrivingWorld)
    assert isinstance(pair.threat, ObservationThreat)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(job.attack_seed)
        policy, attack = pair.load(job.training_seed), pair.armed(job.training_seed)
        env = world.make([job.cell] * len(job.seeds), action_type=policy.action_type, driver=policy.driver)
        trace = Trace([job.seeds.index(seed) for seed in traced]) if traced else None
        try:
            columns = rollout(
                env,
                policy,
                attack if isinstance(attack, DrivingAttack) else None,
                pair.threat,
                job.seeds,
                facts=world.facts,
                attack_seed=job.attack_seed,
                trace=trace,
            )
        finally:
            env.close(raise_if_closed=False)
    return Driven(columns, trace.by_episode(traced) if trace else {})
