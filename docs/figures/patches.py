"""Patches for the figures: crafted once, then kept in the user's cache."""

from __future__ import annotations

from platformdirs import user_cache_path
from torch import Tensor

from bench.detection import PatchThreat, patches
from bench.detection.crafting import craft
from bench.detection.patch import Patch
from bench.errors import UserError
from bench.plugins.pair import Pair, choose
from bench.run.unit import Crafting

KEPT = user_cache_path("cavbench") / "figures"
SHARE = PatchThreat().budget
"""Side of a patch in shares of the sign's."""


def patch_of(attack: str, defense: str = "none", **params: object) -> Patch:
    """The patch of patch seed 0 against the (defended) YOLOv3-tiny; crafting one with `eot` takes some minutes.

    Args:
        attack, defense: names.
        params: of the attack; the defaults of the others.
    """
    pair = Pair(
        attack=choose("attack", attack, **params),
        defense=choose("defense", defense),
        victim=choose("victim", "yolov3_tiny"),
        world=choose("world", "camera"),
        threat=PatchThreat(),
    )
    crafting = Crafting(pair=pair, training_seed=0, weights_sha256=pair.weights_sha256(0))
    try:
        return patches.read(KEPT, crafting.fingerprint)
    except UserError:
        patches.write(KEPT, crafting, craft(crafting, lambda share, said: None))
        return patches.read(KEPT, crafting.fingerprint)


def texels_of(attack: str, defense: str = "none", **params: object) -> Tensor:
    """The texels [3, P, P] of `patch_of`."""
    texels = patch_of(attack, defense, **params).texels
    assert texels is not None
    return texels
