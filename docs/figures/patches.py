"""Patches for the figures: crafted once, then stored in the user's cache."""

from __future__ import annotations

from platformdirs import user_cache_path
from torch import Tensor

from cavbench.attacks.detection.suites import STANDARD_DETECTION_3
from cavbench.core.pair import Pair, choose
from cavbench.detection import PatchThreat
from cavbench.detection.crafting import prepare
from cavbench.detection.patch import Patch
from cavbench.envs.camera.axes import APPROACH_V1
from cavbench.identity.fingerprint import canonical
from cavbench.run import artefacts
from cavbench.run.unit import Unit

KEPT = user_cache_path("cavbench") / "figures"
STRONGER = {**STANDARD_DETECTION_3.members[1].params, "restarts": 1}
"""Parameters of the stronger `eot` of the standard suite, with one start: shifts only."""
SHARE = PatchThreat().budget
"""Side of a patch as a share of the sign's side."""


def patch_of(attack: str, defense: str = "none", **params: object) -> Patch:
    """The patch of patch seed 0 against the (defended) YOLOv3-tiny; crafting one with `eot` takes some minutes.

    Args:
        attack, defense: names of the components.
        params: parameters of the attack; others have their defaults.
    """
    pair = Pair(
        attack=choose("attack", attack, **params),
        defense=choose("defense", defense),
        victim=choose("victim", "yolov3_tiny"),
        world=choose("world", "camera"),
        threat=PatchThreat(),
    )
    unit = Unit(
        pair=pair,
        training_seed=0,
        weights_sha256=pair.weights_sha256(0),
        cell=APPROACH_V1.cells()[0],
        seeds=APPROACH_V1.seeds(),
    )
    path = artefacts.path_of(KEPT, unit)
    if not path.exists():
        crafted = prepare(unit.preparing_job, canonical(unit.artefact_origin), lambda share, said: None)
        artefacts.write(KEPT, unit, crafted)
    return Patch.read(artefacts.read(path))


def texels_of(attack: str, defense: str = "none", **params: object) -> Tensor:
    """The texels [3, P, P] of `patch_of`."""
    texels = patch_of(attack, defense, **params).texels
    assert texels is not None
    return texels
