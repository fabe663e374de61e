"""The work of the driving track: drive one pair of attack and defended victim on every scenario of a cell."""

from __future__ import annotations

from collections.abc import Sequence

from bench.driving import attacker, enforcer, meter, oracle, probes, threat, victim
from bench.driving import rollout as rollouts
from bench.driving.contracts import DrivingAttack, DrivingVictim, DrivingWorld
from bench.driving.policy import Policy
from bench.driving.rollout import Trace, rollout
from bench.driving.threat import ObservationThreat
from bench.errors import UserError
from bench.plugins.pair import Pair
from bench.plugins.track import Driven, Job
from bench.trust.seal import Seal
from bench.trust.streams import Stream

SEAL = Seal(attacker, enforcer, meter, oracle, probes, rollouts, threat, victim)


def drive(job: Job, traced: Sequence[int]) -> Driven:
    """Drive a job's episodes and return the measurements, [B] each (`bench.driving.rollout.rollout`).

    Args:
        job: the job.
        traced: scenario seeds of the episodes to record.
    """
    pair, world = job.pair, job.pair.world.component
    assert isinstance(world, DrivingWorld)
    assert isinstance(pair.threat, ObservationThreat)
    SEAL.check()
    with Stream("load", job.attack_seed).in_use():
        policy, attack = _checked(pair.load(job.training_seed), pair), pair.armed(job.training_seed)
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
                dynamics=world.dynamics(job.cell, policy.action_type),
                entropy=job.entropy,
                trace=trace,
            )
        finally:
            env.close(raise_if_closed=False)
    SEAL.check()
    return Driven(columns, trace.by_episode(traced) if trace else {})


def _checked(policy: Policy, pair: Pair) -> Policy:
    """The policy, if what it says of itself is what its victim says.

    Raises:
        UserError: if its driver or its kind of actions is another.
    """
    declared = pair.victim.component
    assert isinstance(declared, DrivingVictim)
    for name, wanted in (("driver", declared.driver), ("action_type", declared.action_type)):
        if (found := getattr(policy, name)) != wanted:
            raise UserError(
                f"the policy of {pair.defense} + {pair.victim} has {name} {found!r}, its victim declares {wanted!r}"
            )
    if declared.driver != "agent" and declared.sees:
        raise UserError(
            f"the world drives victim {pair.victim.name!r} itself ({declared.driver}): it must declare sees = False"
        )
    return policy
