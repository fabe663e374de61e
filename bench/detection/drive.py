"""The work of the detection track: run a defended detector on every approach of a cell, with the patch on the sign."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from torch import Tensor

from bench.detection import (
    approach,
    boxes,
    closed_loop,
    crafting,
    discrimination,
    driver,
    enforcer,
    oracle,
    precision,
    printing,
    sight,
    stopping,
    threat,
)
from bench.detection.approach import Sighting, Trace, check_approaches, score
from bench.detection.closed_loop import Drive, Drives
from bench.detection.contracts import CameraWorld
from bench.detection.detector import Detector
from bench.detection.patch import Patch
from bench.detection.placed import placed
from bench.errors import UserError
from bench.plugins.track import Driven, Job
from bench.trust.seal import Seal
from bench.trust.streams import Stream
from bench.trust.watch import Watch

SEAL = Seal(
    approach,
    boxes,
    closed_loop,
    crafting,
    discrimination,
    driver,
    enforcer,
    oracle,
    precision,
    printing,
    sight,
    stopping,
    threat,
)


def drive(job: Job, artefact: bytes | None, traced: Sequence[int]) -> Driven:
    """Run a job's approaches and return the measurements, [A] each (`bench.detection.approach.score`).

    Args:
        job: the job.
        artefact: content of the patch file; None if there is no patch.
        traced: scenario seeds of the approaches to record.
    """
    pair, world = job.pair, job.pair.world.component
    assert isinstance(world, CameraWorld)
    patch = _patch(artefact, job.artefact) if artefact else None
    SEAL.check()
    with Stream("load", job.attack_seed).in_use():
        detector = placed(pair.load(job.training_seed), job.device)
        approaches = world.approaches(job.cell, job.seeds)
        check_approaches(approaches, job.seeds, type(world).__name__)
        trace = Trace([job.seeds.index(seed) for seed in traced]) if traced else None
        with Watch(detector, "detector", "defense", listens=False):
            columns = score(detector, approaches, patch, share=pair.threat.budget, entropy=job.entropy, trace=trace)
            sightings = trace.sightings if trace else []
            driven, sightings = _driven(job, detector, patch.texels if patch else None, sightings)
    SEAL.check()
    made = {"patch": np.array([job.artefact] * len(approaches))}
    columns |= closed_loop.measured(driven, len(approaches)) | made
    return Driven(columns, dict(zip(traced, sightings, strict=True)))


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


def _patch(artefact: bytes, fingerprint: str) -> Patch:
    try:
        return Patch.read(artefact)
    except UserError as error:
        raise UserError(
            f"the patch {fingerprint}.safetensors is {error}; delete it and run again to craft a new one"
        ) from error
