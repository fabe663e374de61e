"""The patch by random search: what it finds, what it asks for, and a black box."""

from __future__ import annotations

import torch
from torch import Tensor

from cavbench.attacks.detection.square_patch import SquarePatch
from cavbench.defenses.detection.temporal import TemporalFusion
from cavbench.detection import Detector, PatchThreat
from cavbench.detection.access import PatchEnforcer
from tests.attacks.detection.test_eot import SCENES, red
from tests.plugins.toy_camera import RedDetector, RedStreet, RedVictim

QUICK = SquarePatch(texels=16, steps=40, views=4, renew=10, window=32)


def crafted(
    attack: SquarePatch, seed: int = 0, detector: Detector | None = None, threat: PatchThreat | None = None
) -> tuple[Tensor, PatchEnforcer]:
    generator = torch.Generator().manual_seed(seed)
    enforcer = PatchEnforcer(detector or RedDetector(), threat or PatchThreat(), attack.access, generator)
    return attack.craft(enforcer.oracle, SCENES, lambda share, text: None), enforcer


def test_squares_lead_to_the_optimum() -> None:
    """The toy detector measures red, so the best patch is cyan, which squares of one colour can make."""
    patch, _ = crafted(SquarePatch(texels=16, steps=400, views=4, renew=50, window=32))
    best = red(torch.tensor([0.0, 1.0, 1.0])[:, None, None].expand(3, 8, 8))
    start = red(QUICK._stripes(torch.Generator().manual_seed(0)))
    assert best <= red(patch) < best + 0.5 * (start - best)


def test_each_channel_of_each_texel_is_0_or_1() -> None:
    patch, _ = crafted(QUICK)
    assert patch.shape == (3, 16, 16)
    assert set(patch.unique().tolist()) <= {0.0, 1.0}


def test_printed_squares_are_printable() -> None:
    threat = PatchThreat(norm="print")
    patch, _ = crafted(QUICK, threat=threat)
    assert torch.equal(threat.confine(patch), patch)
    assert 0 < patch.min() < patch.max() < 1


def test_it_needs_scores_only_and_asks_about_the_views_of_each_step() -> None:
    _, enforcer = crafted(QUICK)
    assert (enforcer.access, enforcer.backwards) == ("scores", 0)
    assert enforcer.spent == 4 * (40 + 4)


def test_it_stops_at_the_query_budget() -> None:
    patch, enforcer = crafted(QUICK, threat=PatchThreat(queries=30))
    assert enforcer.spent == 4 * (1 + 6)
    assert torch.equal(patch, crafted(QUICK, threat=PatchThreat(queries=31))[0])
    assert crafted(QUICK, threat=PatchThreat(queries=4))[1].spent == 0


def test_the_patch_depends_on_the_seed_only() -> None:
    first, again, other = (crafted(QUICK, seed)[0] for seed in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_squares_become_smaller() -> None:
    blank, generator = torch.full((3, 16, 16), 0.5), torch.Generator().manual_seed(0)
    sides = [
        round(float((QUICK._painted(blank, done, generator) != 0.5).sum() / 3) ** 0.5) for done in (0, 0.1, 0.5, 0.9)
    ]
    assert sides == [9, 2, 1, 1]


def test_a_memory_is_attacked_as_a_whole() -> None:
    """Against a detector that adds up evidence the loss is that of the scores which it reports."""
    detector = TemporalFusion().load(RedVictim(), 0, RedStreet().facts)
    patch, enforcer = crafted(QUICK, detector=detector)
    assert enforcer.spent == 4 * (40 + 4)
    assert red(patch) < red(QUICK._stripes(torch.Generator().manual_seed(0)))
