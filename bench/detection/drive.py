"""The work of the detection track: run a defended detector on every approach of a cell, with the patch on the sign."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from torch import Tensor

from cavbench.core.progress import share_done
from cavbench.core.track import Driven, Job
from cavbench.detection import (
    access,
    approach,
    boxes,
    closed_loop,
    crafting,
    discrimination,
    driver,
    mount,
    precision,
    printing,
    reports,
    sight,
    stopping,
    threat,
)
from cavbench.detection.approach import Sighting, Trace, Unpatched, check_approaches, mounted, score
from cavbench.detection.closed_loop import Drive, Drives
from cavbench.detection.contracts import CameraWorld
from cavbench.detection.detector import Detector
from cavbench.detection.patch import Patch, read_all
from cavbench.detection.placed import placed
from cavbench.detection.scenes import Approach
from cavbench.errors import UserError
from cavbench.isolation.modes import kept
from cavbench.isolation.seal import Seal
from cavbench.isolation.streams import Stream
from cavbench.isolation.watch import Watch

SEAL = Seal(
    access,
    approach,
    boxes,
    closed_loop,
    crafting,
    discrimination,
    driver,
    mount,
    precision,
    printing,
    reports,
    sight,
    stopping,
    threat,
)


def drive(job: Job, artefact: bytes | None, traced: Sequence[int]) -> Driven:
    """Run a job's approaches and return the measurements, [A] each (`cavbench.detection.approach.score`).

    Args:
        job: the job.
        artefact: content of the patch file; None if there is no patch.
        traced: scenario seeds of the approaches to record.
    """
    (driven,) = _carried_out([job], {job.artefact: artefact} if artefact else {}, traced)
    return driven


def drive_jointly(jobs: Sequence[Job], artefacts: Mapping[str, bytes]) -> Sequence[Driven] | None:
    """Run jobs that differ in their attacks alone: what does not depend on the patch is done once for all.

    Args:
        jobs: the jobs.
        artefacts: contents of the patch files, by `Job.artefact`.

    Returns:
        None if one of them fails.
    """
    try:
        return _carried_out(jobs, artefacts)
    # Whatever went wrong is found again, and named, where the jobs are carried out one by one.
    except Exception:
        return None


def _carried_out(jobs: Sequence[Job], artefacts: Mapping[str, bytes], traced: Sequence[int] = ()) -> list[Driven]:
    """The measurements of each job; `traced` approaches are recorded of the only one."""
    first = jobs[0]
    found: list[Driven] = []
    pair, world = first.pair, first.pair.world.component
    assert isinstance(world, CameraWorld)
    patches = [_patches(artefacts[job.artefact], job) if job.artefact in artefacts else [None] for job in jobs]
    SEAL.check()
    with Stream("load", first.attack_seed).in_use(), kept("defense"):
        # Before any code of the defence runs, which could change what these are made from.
        approaches = world.approaches(first.cell, first.seeds)
        check_approaches(approaches, first.seeds, type(world).__name__)
        assert isinstance(pair.threat, threat.PatchThreat)
        approaches = mounted(approaches, pair.threat.mount)
        detector = placed(pair.load(first.training_seed), first.device)
    with Watch(detector, "detector", "defense", listens=False):
        with Stream("victim", first.attack_seed).in_use():
            unpatched = Unpatched.of(detector, approaches, pair.threat.budget)
        for job, own in zip(jobs, patches, strict=True):
            share_done(len(found) / len(jobs))
            # A random detector draws the same whatever patches it saw before. Its seed is that of crafting: it tells nothing.
            with Stream("victim", job.attack_seed).in_use():
                if len(own) == 1:
                    found.append(_scored(job, detector, approaches, own[0], unpatched, traced))
                else:
                    found.append(_at_sites(job, detector, approaches, own, unpatched, traced))
    SEAL.check()
    return found


def _scored(
    job: Job,
    detector: Detector,
    approaches: Sequence[Approach],
    patch: Patch | None,
    unpatched: Unpatched,
    traced: Sequence[int],
) -> Driven:
    """The measurements of a job under its patch."""
    trace = Trace([job.seeds.index(seed) for seed in traced]) if traced else None
    columns = score(
        detector,
        approaches,
        patch,
        share=job.pair.threat.budget,
        entropy=job.entropy,
        trace=trace,
        unpatched=unpatched,
    )
    sightings = trace.sightings if trace else []
    driven, sightings = _driven(job, detector, patch.texels if patch else None, sightings)
    made = {"patch": np.array([job.artefact] * len(approaches))}
    columns |= closed_loop.measured(driven, len(approaches)) | made
    return Driven(columns, dict(zip(traced, sightings, strict=True)))


def _at_sites(
    job: Job,
    detector: Detector,
    approaches: Sequence[Approach],
    patches: Sequence[Patch | None],
    unpatched: Unpatched,
    traced: Sequence[int],
) -> Driven:
    """The measurements of a job with a patch of its own on each approach."""
    parts = []
    for number, (seen, patch) in enumerate(zip(approaches, patches, strict=True)):
        one = replace(job, seeds=job.seeds[number : number + 1])
        own = [seed for seed in traced if seed == seen.seed]
        parts.append(_scored(one, detector, [seen], patch, unpatched.at(number), own))
    columns = {name: np.concatenate([part.columns[name] for part in parts]) for name in parts[0].columns}
    return Driven(columns, {seed: trace for part in parts for seed, trace in part.traces.items()})


def _driven(
    job: Job, detector: Detector, texels: Tensor | None, sightings: list[Sighting]
) -> tuple[Drive | None, list[Sighting]]:
    """The drive in closed loop, None if the world has none, and the sightings with it and with the drive without the patch."""
    world, share = job.pair.world.component, job.pair.threat.budget
    assert isinstance(world, CameraWorld)
    env = world.environment(job.cell, job.seeds, texels, share)
    if env is None:
        return None, sightings
    draws = [job.seeds.index(one.approach.seed) for one in sightings]
    shown, clean = closed_loop.drive(detector, env, draws), None
    if sightings and texels is not None and (bare := world.environment(job.cell, job.seeds, None, share)):
        clean = closed_loop.drive(detector, bare, draws)
    return shown, [
        replace(one, drives=Drives(shown, clean, draw, env.plan)) for one, draw in zip(sightings, draws, strict=True)
    ]


def _patches(artefact: bytes, job: Job) -> list[Patch]:
    """The patch of a job; for an attacker who knows the sites, one for each approach."""
    try:
        found = read_all(artefact)
        known = job.pair.threat.known(job.cell, job.pair.world.component.facts.axes) is not None
        if len(found) != (len(job.seeds) if known else 1):
            raise UserError("of other approaches")
        return found
    except UserError as error:
        raise UserError(
            f"the patch {job.artefact}.safetensors is {error}; delete it and run again to craft a new one"
        ) from error
