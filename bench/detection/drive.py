"""The work of the detection track: run a defended detector on every approach of a cell, with the patch on the sign."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bench.detection import (
    approach,
    boxes,
    crafting,
    discrimination,
    enforcer,
    oracle,
    precision,
    printing,
    sight,
    stopping,
    threat,
)
from bench.detection.approach import Trace, check_approaches, score
from bench.detection.contracts import CameraWorld
from bench.detection.patch import Patch
from bench.detection.placed import placed
from bench.errors import UserError
from bench.plugins.track import Driven, Job
from bench.trust.seal import Seal
from bench.trust.streams import Stream
from bench.trust.watch import Watch

SEAL = Seal(approach, boxes, crafting, discrimination, enforcer, oracle, precision, printing, sight, stopping, threat)


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
    SEAL.check()
    made = {"patch": np.array([job.artefact] * len(approaches))}
    return Driven(columns | made, dict(zip(traced, trace.sightings, strict=True)) if trace else {})


def _patch(artefact: bytes, fingerprint: str) -> Patch:
    try:
        return Patch.read(artefact)
    except UserError as error:
        raise UserError(
            f"the patch {fingerprint}.safetensors is {error}; delete it and run again to craft a new one"
        ) from error
