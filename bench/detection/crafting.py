"""Crafts a patch: the work of `bench.run.unit.Crafting`."""

from __future__ import annotations

import time

import torch

from bench.detection.threat import Patch, PatchThreat, VisionOracle
from bench.errors import UserError
from bench.plugins.contracts import Progress
from bench.plugins.fingerprint import state_digest
from bench.run.unit import Crafting


def craft(crafting: Crafting, progress: Progress) -> Patch:
    """The patch of an attack on a defended detector; only the training scenes of the world are looked at.

    Raises:
        UserError: if the attack asks for too much, returns what is no patch, or changes the detector's weights.
    """
    attack, defense, victim, world = (part.component for part in crafting.parts)
    threat = crafting.pair.threat
    assert isinstance(threat, PatchThreat)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(crafting.attack_seed)
        detector = defense.load(victim, crafting.training_seed)
        generator = torch.Generator().manual_seed(crafting.attack_seed)
        oracle = VisionOracle(detector, threat, attack.access, generator)
        scenes, before, start = world.training_scenes(), state_digest(detector), time.perf_counter()
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
