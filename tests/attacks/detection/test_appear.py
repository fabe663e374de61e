"""The appearing attack: the same loop the other way round."""

from __future__ import annotations

import torch

from cavbench.attacks.detection.appear import Appear
from cavbench.detection import PatchThreat
from cavbench.detection.access import PatchEnforcer
from tests.attacks.detection.test_eot import SCENES, red
from tests.plugins.toy_camera import RedDetector


def test_it_raises_the_score_that_eot_lowers() -> None:
    """The toy detector measures red, so the best plate is red."""
    attack = Appear(texels=16, steps=60, batch=4, window=32)
    threat = PatchThreat(shape="plate")
    enforcer = PatchEnforcer(RedDetector(), threat, attack.access, torch.Generator().manual_seed(0))
    patch = attack.craft(enforcer.oracle, SCENES, lambda share, text: None)
    best = red(torch.tensor([1.0, 0.0, 0.0])[:, None, None].expand(3, 8, 8))
    start = red(torch.full((3, 8, 8), 0.5))
    assert red(patch) > start + 0.6 * (best - start)
    assert enforcer.spent == 60 * 4
