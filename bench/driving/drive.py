"""The work of the driving track: drive one pair of attack and defended victim on every scenario of a cell."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from functools import partial
from itertools import accumulate, pairwise

from cavbench.core.pair import Pair
from cavbench.core.track import Driven, Job
from cavbench.driving import (
    access,
    alarms,
    attacker,
    blame,
    draws,
    forgery,
    forging,
    gradients,
    invented,
    meter,
    parts,
    probes,
    rss,
    sets,
    shadows,
    surroundings,
    threat,
    traffic,
    victim,
)
from cavbench.driving import rollout as rollouts
from cavbench.driving.contracts import DrivingAttack, DrivingVictim, DrivingWorld
from cavbench.driving.features import Control
from cavbench.driving.meter import Columns
from cavbench.driving.placed import placed
from cavbench.driving.policy import Policy
from cavbench.driving.rollout import Trace, rollout
from cavbench.driving.threat import ObservationThreat
from cavbench.errors import UserError
from cavbench.isolation.modes import kept
from cavbench.isolation.seal import Seal
from cavbench.isolation.streams import Stream

SEAL = Seal(
    access,
    alarms,
    attacker,
    blame,
    draws,
    forgery,
    forging,
    gradients,
    invented,
    meter,
    parts,
    probes,
    rollouts,
    rss,
    sets,
    shadows,
    surroundings,
    threat,
    traffic,
    victim,
)


def drive(job: Job, traced: Sequence[int]) -> Driven:
    """Drive a job's episodes and return the measurements, [B] each (`cavbench.driving.rollout.rollout`).

    Args:
        job: the job.
        traced: scenario seeds of the episodes to record.
    """
    trace = Trace([job.seeds.index(seed) for seed in traced]) if traced else None
    return Driven(_columns([job], trace), trace.by_episode(traced) if trace else {})


def joint(pair: Pair) -> bool:
    """Whether `drive_jointly` can drive several jobs of a pair in one batch."""
    return pair.is_clean or bool(vars(type(pair.attack.component)).get("joint"))


def drive_jointly(jobs: Sequence[Job]) -> Sequence[Driven] | None:
    """Drive jobs of one pair, training seed and entropy in one batch, with the measurements that each has alone.

    One batch shares the cost of the many operations that take as long for one episode as for a hundred.

    Args:
        jobs: jobs in different cells, with different attack seeds.

    Returns:
        None if they must be driven one by one: their results would differ, or one of them fails.
    """
    try:
        columns = _columns(jobs)
    # Whatever went wrong is found again, and named, where the jobs are driven one by one.
    except Exception:
        return None
    ends = list(accumulate((len(job.seeds) for job in jobs), initial=0))
    return [Driven({name: values[a:b] for name, values in columns.items()}) for a, b in pairwise(ends)]


def _columns(jobs: Sequence[Job], trace: Trace | None = None) -> Columns:
    """The measurements of the episodes of all jobs, one after the other."""
    first = jobs[0]
    pair, world = first.pair, first.pair.world.component
    assert isinstance(world, DrivingWorld)
    assert isinstance(pair.threat, ObservationThreat)
    SEAL.check()
    with Stream("load", first.attack_seed).in_use():
        cells = [job.cell for job in jobs for _ in job.seeds]
        # Before any code of the attack or the defence runs, which could change what these are made from.
        facts, threat, declared = deepcopy(world.facts_at(first.cell)), deepcopy(pair.threat), _declared(pair)
        attack = pair.attack.component
        control = Control(
            action_type=declared.action_type,
            driver=declared.driver,
            traffic=threat.traffic if getattr(attack, "drives", False) else None,
            surroundings=threat.dynamics,
        )
        env = world.build(cells, control)
        try:
            dynamics = world.dynamics(cells, declared.action_type)
            with kept("defense", "attack"):
                policy = _checked(pair.load(first.training_seed, first.cell), pair)
                attack = pair.armed(first.training_seed)
            policy = placed(policy, first.device)
            columns = rollout(
                env,
                policy,
                attack if isinstance(attack, DrivingAttack) else None,
                threat,
                [seed for job in jobs for seed in job.seeds],
                facts=facts,
                attack_seed=[job.attack_seed for job in jobs for _ in job.seeds],
                dynamics=dynamics,
                entropy=first.entropy,
                trace=trace,
                judge=partial(world.blame, cells, control),
            )
        finally:
            env.close(raise_if_closed=False)
    SEAL.check()
    return columns


def _declared(pair: Pair) -> DrivingVictim:
    declared = pair.victim.component
    assert isinstance(declared, DrivingVictim)
    return declared


def _checked(policy: Policy, pair: Pair) -> Policy:
    """The policy, if what it says of itself is what its victim says.

    Raises:
        UserError: if its driver or its kind of actions is another.
    """
    declared = _declared(pair)
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
