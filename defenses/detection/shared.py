"""Networks of defences in whose training no victim plays a part: one that was trained beside one victim serves all."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import suppress

from torch import nn

from cavbench import zoo
from cavbench.detection import Detector, DetectorDefense, DetectorVictim
from cavbench.detection.victims.yolov3_tiny import YOLOv3Tiny
from cavbench.errors import UserError

HOST = YOLOv3Tiny()
"""The victim beside which the networks of the zoo were trained."""


def load(
    defense: DetectorDefense,
    victim: DetectorVictim,
    trained: int,
    *,
    name: str,
    part: nn.Module,
    defended: Callable[[], Detector],
) -> Detector:
    """The defended victim: with its own network of the defence where the zoo has one, otherwise with that of `HOST`.

    Args:
        defense: as it was trained.
        victim: the victim.
        trained: training seed of the network.
        name: of the network in the defended detector.
        part: the network; it gets the weights.
        defended: makes the defended detector, which has the network.

    Raises:
        UserError: if the zoo has neither.
    """
    recipe = zoo.Recipe.of(HOST, defense)
    if _is_own(defense, victim, trained) or trained not in zoo.seeds(recipe):
        recipe = zoo.Recipe.of(victim, defense)
    sha256 = zoo.load_part(recipe, trained, name, part)
    detector = defended()
    begun = zoo.card(recipe, trained).get("start")
    if isinstance(begun, dict) and begun.get("sha256") == detector.weights_sha256:
        detector.weights_sha256 = sha256
    else:  # Two detectors behind the same network are not the same.
        both = f"{detector.weights_sha256} {sha256}"
        detector.weights_sha256 = hashlib.sha256(both.encode()).hexdigest()
    return detector


def _is_own(defense: DetectorDefense, victim: DetectorVictim, trained: int) -> bool:
    """Whether the zoo has a network that was trained beside the victim; a detector from elsewhere has no name there."""
    with suppress(UserError):
        return trained in zoo.seeds(zoo.Recipe.of(victim, defense))
    return False
