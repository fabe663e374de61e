"""Craft a patch: run an attack on a defended detector with the training scenes of a world."""

from __future__ import annotations

import time
from copy import deepcopy

import torch
from torch import Tensor

from cavbench.core.contracts import Progress
from cavbench.core.track import Job
from cavbench.detection import joined
from cavbench.detection.access import PatchEnforcer
from cavbench.detection.contracts import CameraWorld, PatchAttack
from cavbench.detection.detector import Detector
from cavbench.detection.patch import Patch, written_together
from cavbench.detection.placed import placed
from cavbench.detection.scenes import Scenes
from cavbench.detection.threat import PatchThreat
from cavbench.errors import UserError
from cavbench.isolation.kept import unchanged
from cavbench.isolation.modes import kept
from cavbench.isolation.streams import Stream
from cavbench.isolation.watch import Watch


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
        UserError: if the attack exceeds the threat model, or returns no valid patch.
        TamperError: if it changes the detector, or asks it past the oracle.
    """
    generator, threat = torch.Generator().manual_seed(attack_seed), deepcopy(threat)
    with (
        Stream("victim", attack_seed).in_use(),
        unchanged({type(attack).__name__: attack}, "attack"),
        unchanged({"the training scenes": scenes}, "attack", arrays=True),
        Watch(detector, "detector") as watch,
    ):
        enforcer = PatchEnforcer(detector, threat, attack.access, generator, watch, Stream("attack", attack_seed))
        start = time.perf_counter()
        with enforcer.turn():
            answer = attack.craft(enforcer.oracle, scenes.apart(), progress)
        seconds = time.perf_counter() - start
    if answer is not None and type(answer) is not Tensor:
        raise UserError(f"the attack returned a {type(answer).__name__}, not a torch.Tensor")
    texels, excess = threat.project(answer) if answer is not None else (None, 0.0)
    return Patch(
        texels=texels,
        queries=enforcer.spent,
        gradients=enforcer.backwards,
        zero_gradients=enforcer.zeros,
        nan_gradients=enforcer.nans,
        seconds=seconds,
        excess=excess,
        evolution=enforcer.reports.evolution,
    )


def prepare(job: Job, made_by: str, progress: Progress) -> bytes:
    """Craft the patch of a job's pair and training seed; return the content of its file (`cavbench.detection.patch`).

    For an attacker who knows the site there is a patch for each of the job's approaches, crafted on its own frames.
    """
    pair = job.pair
    attack, world, threat = pair.armed(job.training_seed), pair.world.component, pair.threat
    assert isinstance(attack, PatchAttack)
    assert isinstance(world, CameraWorld)
    assert isinstance(threat, PatchThreat)
    with Stream("load", job.attack_seed).in_use():
        sites = joined.sites(world, threat, job.cell, job.seeds) or [world.training_scenes()]
        with kept("defense"):
            detector = placed(pair.load(job.training_seed), job.device)

        def one(number: int) -> Patch:
            def tell(share: float, text: str) -> None:
                progress((number + share) / len(sites), text)

            scenes = sites[number].mounted(threat.mount)
            return craft(attack, detector, scenes, threat, attack_seed=job.attack_seed, progress=tell)

        made = {id(scenes): number for number, scenes in reversed([*enumerate(sites)])}
        made_of = {number: one(number) for number in sorted(made.values())}
        patches = [made_of[made[id(scenes)]] for scenes in sites]
    if threat.knows == "universal":
        return patches[0].written(made_by)
    return written_together(patches, made_by)
