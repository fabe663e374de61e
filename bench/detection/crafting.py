"""Craft a patch: run an attack on a defended detector with the training scenes of a world."""

from __future__ import annotations

import time

import torch

from bench.detection.contracts import CameraWorld, PatchAttack
from bench.detection.detector import Detector
from bench.detection.oracle import PatchOracle
from bench.detection.patch import Patch
from bench.detection.scenes import Scenes
from bench.detection.threat import PatchThreat
from bench.errors import UserError
from bench.plugins.contracts import Progress
from bench.plugins.fingerprint import state_digest
from bench.plugins.track import Job


def craft(
    attack: PatchAttack,
    detector: Detector,
    scenes: Scenes,
    threat: PatchThreat,
    *,
    attack_seed: int,
    progress: Progress,
) -> Patch:
    """The patch of an attack on a defended detector.

    Args:
        attack: the attack.
        detector: the (defended) victim.
        scenes: the scenes to craft on.
        threat: threat model, enforced on the attack.
        attack_seed: seed of the attack's random generator.
        progress: called with the finished share.

    Raises:
        UserError: if the attack exceeds the threat model, returns no valid patch, or changes the detector's weights.
    """
    generator = torch.Generator().manual_seed(attack_seed)
    oracle = PatchOracle(detector, threat, attack.access, generator)
    before, start = state_digest(detector), time.perf_counter()
    answer = attack.craft(oracle, scenes, progress)
    seconds = time.perf_counter() - start
    if state_digest(detector) != before:
        raise UserError("the attack changed the detector's weights")
    texels, excess = threat.project(answer) if answer is not None else (None, 0.0)
    return Patch(
        texels=texels,
        queries=oracle.spent,
        gradients=oracle.backwards,
        zero_gradients=oracle.zeros,
        seconds=seconds,
        excess=excess,
        evolution=oracle.evolution,
    )


def prepare(job: Job, made_by: str, progress: Progress) -> bytes:
    """Craft the patch of a job's pair and training seed; return the content of its file (`bench.detection.patch`)."""
    pair = job.pair
    attack, world, threat = pair.armed(job.training_seed), pair.world.component, pair.threat
    assert isinstance(attack, PatchAttack)
    assert isinstance(world, CameraWorld)
    assert isinstance(threat, PatchThreat)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(job.attack_seed)
        detector = pair.load(job.training_seed)
        scenes = world.training_scenes()
        patch = craft(attack, detector, scenes, threat, attack_seed=job.attack_seed, progress=progress)
    return patch.written(made_by)
