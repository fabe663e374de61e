"""The work of the detection track: run a defended detector on every approach of a cell, with the patch on the sign."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace
from itertools import groupby

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
from cavbench.detection.approach import Columns, Sighting, Trace, Unpatched, check_approaches, mounted, score
from cavbench.detection.closed_loop import Drive, Drives
from cavbench.detection.contracts import CameraWorld
from cavbench.detection.detector import Detector
from cavbench.detection.patch import Patch, read_all
from cavbench.detection.placed import placed
from cavbench.detection.scenes import Approach
from cavbench.detection.sight import Sight
from cavbench.errors import UserError
from cavbench.isolation.modes import kept
from cavbench.isolation.seal import Seal
from cavbench.isolation.streams import Stream
from cavbench.isolation.watch import Watch, marks

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
    """Run jobs that differ in their attacks, or in axes that change no frame: what they have in common is done once for all.

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
    first, count = jobs[0], len(jobs[0].seeds)
    found: list[Driven] = []
    pair, world = first.pair, first.pair.world.component
    assert isinstance(world, CameraWorld)
    patches = [_patches(artefacts[job.artefact], job) if job.artefact in artefacts else [None] for job in jobs]
    SEAL.check()
    with Stream("load", first.attack_seed).in_use(), kept("defense"):
        # Before any code of the defence runs, which could change what these are made from.
        cells = list(dict.fromkeys(job.cell for job in jobs))
        every = [world.approaches(cell, first.seeds) for cell in cells]
        for approaches in every:
            check_approaches(approaches, first.seeds, type(world).__name__)
        assert isinstance(pair.threat, threat.PatchThreat)
        # Together, so that cells with the same scenes still have the same.
        shown = mounted([one for approaches in every for one in approaches], pair.threat.mount)
        of_cell = {cell: shown[place * count :][:count] for place, cell in enumerate(cells)}
        detector = placed(pair.load(first.training_seed), first.device)
    _check_loads_alike(detector, jobs)
    with Watch(detector, "detector", "defense", listens=False):
        common = Common(detector, pair.threat.budget)
        for job, own in zip(jobs, patches, strict=True):
            share_done(len(found) / len(jobs))
            approaches = of_cell[job.cell]
            found.append(common.driven(job, approaches, own, common.unpatched(job, approaches), traced))
    SEAL.check()
    return found


def _check_loads_alike(detector: Detector, jobs: Sequence[Job]) -> None:
    """Raise UserError if the detector of another job has other weights, because they are drawn when it is loaded."""
    first, weights = jobs[0], ""
    for seed in {job.attack_seed for job in jobs} - {first.attack_seed}:
        weights = weights or marks(detector)["weights"]
        with Stream("load", seed).in_use(), kept("defense"):
            other = placed(first.pair.load(first.training_seed), first.device)
        if marks(other)["weights"] != weights:
            raise UserError("it is another detector in each cell")


class Common:
    """What jobs of a detector have in common: all that follows from frames and patch alone, without a random number.

    Args:
        detector: the (defended) victim.
        share: side of patches as a share of the sign's side.
    """

    def __init__(self, detector: Detector, share: float) -> None:
        self._detector, self._share = detector, share
        self._unpatched: dict[Hashable, Unpatched] = {}
        self._measured: dict[Hashable, tuple[Columns, dict[str, Sight]]] = {}

    def unpatched(self, job: Job, approaches: Sequence[Approach]) -> Unpatched:
        """What is the same whatever patch is on the sign."""
        scenes = _scenes(approaches)
        # A random detector draws the same whatever patches it saw before.
        for key in (scenes, (*scenes, job.attack_seed)):
            if key in self._unpatched:
                return self._unpatched[key]
        stream = Stream("victim", job.attack_seed)
        with stream.in_use():
            found = Unpatched.of(self._detector, approaches, self._share)
        self._unpatched[(*scenes, job.attack_seed) if stream.used() else scenes] = found
        return found

    def driven(
        self,
        job: Job,
        approaches: Sequence[Approach],
        patches: Sequence[Patch | None],
        unpatched: Unpatched,
        traced: Sequence[int],
    ) -> Driven:
        """The measurements of a job under its patch, or under a patch of its own on each approach."""
        # Its seed is that of crafting: it tells nothing.
        stream = Stream("victim", job.attack_seed)
        if len(patches) == 1:
            return self._scored(job, approaches, patches[0], unpatched, traced, stream)
        alike = [
            (id(one.scenes), patch.sha256 if patch else "") for one, patch in zip(approaches, patches, strict=True)
        ]
        parts = []
        for _, group in groupby(range(len(patches)), alike.__getitem__):
            first, *others = group
            end = first + len(others) + 1
            part = replace(job, seeds=job.seeds[first:end])
            own = [seed for seed in traced if seed in part.seeds]
            known = unpatched.at(first, end)
            parts.append(self._scored(part, approaches[first:end], patches[first], known, own, stream))
        columns = {name: np.concatenate([part.columns[name] for part in parts]) for name in parts[0].columns}
        return Driven(columns, {seed: trace for part in parts for seed, trace in part.traces.items()})

    def _scored(
        self,
        job: Job,
        approaches: Sequence[Approach],
        patch: Patch | None,
        unpatched: Unpatched,
        traced: Sequence[int],
        stream: Stream,
    ) -> Driven:
        """The measurements of a job under one patch."""
        key = (job.pair.id, job.artefact, patch.sha256 if patch else "", job.seeds, job.entropy, *_scenes(approaches))
        trace = Trace([job.seeds.index(seed) for seed in traced]) if traced else None
        columns, seen = self._measured.get(key, ({}, {}))
        with stream.in_use():
            columns = columns or score(
                self._detector,
                approaches,
                patch,
                share=self._share,
                entropy=job.entropy,
                trace=trace,
                unpatched=unpatched,
            )
            sightings = trace.sightings if trace else []
            driven, sightings = _driven(job, self._detector, patch.texels if patch else None, sightings, seen)
        if not stream.used():
            self._measured[key] = columns, seen
        made = {"patch": np.array([job.artefact] * len(approaches))}
        columns = {**columns, **closed_loop.measured(driven, len(approaches)), **made}
        return Driven(columns, dict(zip(traced, sightings, strict=True)))


def _scenes(approaches: Sequence[Approach]) -> tuple[int, ...]:
    """Equal for approaches with the same scenes."""
    return tuple(id(one.scenes) for one in approaches)


def _driven(
    job: Job, detector: Detector, texels: Tensor | None, sightings: list[Sighting], seen: dict[str, Sight]
) -> tuple[Drive | None, list[Sighting]]:
    """The drive in closed loop, None if the world has none, and the sightings with it and with the drive without the patch.

    `seen` is that of `closed_loop.drive`.
    """
    world, share = job.pair.world.component, job.pair.threat.budget
    assert isinstance(world, CameraWorld)
    env = world.environment(job.cell, job.seeds, texels, share)
    if env is None:
        return None, sightings
    draws = [job.seeds.index(one.approach.seed) for one in sightings]
    shown, clean = closed_loop.drive(detector, env, draws, seen), None
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
