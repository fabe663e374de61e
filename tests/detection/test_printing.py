"""What can be printed: the gamut holds every mix of the inks, nothing else, and its projection is one."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cavbench.attacks.detection.eot import EOT
from cavbench.detection import PatchThreat
from cavbench.detection.access import PatchEnforcer
from cavbench.detection.colour import linear, srgb
from cavbench.detection.printing import LEAST, MOST, inks, non_printability, printed, triplets
from tests.plugins.toy_camera import RedDetector, RedScenes

COLOURS = arrays(np.float32, (3, 8, 8), elements=st.floats(0, 1, width=32))
SCENES = RedScenes(torch.linspace(30, 8, 5))


def crafted(attack: EOT, norm: str) -> torch.Tensor:
    torch.manual_seed(0)
    threat = PatchThreat(norm=norm)  # type: ignore[arg-type]
    enforcer = PatchEnforcer(RedDetector(), threat, attack.access, torch.Generator().manual_seed(0))
    return attack.craft(enforcer.oracle, SCENES, lambda share, text: None)


@settings(deadline=None)
@given(texels=COLOURS)
def test_what_was_printed_can_be_printed_and_reflects_neither_too_little_nor_too_much(texels: np.ndarray) -> None:
    once = printed(torch.from_numpy(texels))
    torch.testing.assert_close(printed(once), once, atol=2e-5, rtol=0)
    light = linear(once)
    assert LEAST - 1e-4 <= light.min() <= light.max() <= MOST + 1e-4


@settings(deadline=None)
@given(shares=arrays(np.float64, 9, elements=st.floats(0.01, 1)))
def test_every_halftone_of_the_inks_can_be_printed(shares: np.ndarray) -> None:
    mixed = (shares[:, None] * np.stack(list(inks().values()))).sum(0) / shares.sum()
    texels = srgb(torch.from_numpy(mixed).float()).reshape(3, 1, 1)
    torch.testing.assert_close(printed(texels), texels, atol=1e-4, rtol=0)


@pytest.mark.parametrize(
    "colour", [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (1.0, 0.0, 1.0), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)]
)
def test_colours_of_a_screen_cannot_be_printed_and_keep_their_hue(colour: tuple[float, float, float]) -> None:
    texel = torch.tensor(colour).reshape(3, 1, 1)
    shown = printed(texel).flatten()
    assert (shown - texel.flatten()).abs().max() > 0.05
    # Of two channels, the one with more light keeps more.
    assert (shown.argsort(stable=True) == texel.flatten().argsort(stable=True)).all() or shown.std() < 0.05


def test_the_gradient_passes_the_printer() -> None:
    texels = torch.rand(3, 8, 8, generator=torch.Generator().manual_seed(0)).requires_grad_(True)
    (gradient,) = torch.autograd.grad(printed(texels).sum(), texels)
    assert gradient.isfinite().all()
    assert gradient.abs().sum() > 0


def test_the_non_printability_score_is_0_for_the_triplets_and_the_distance_for_others() -> None:
    assert triplets().shape == (30, 3)
    assert non_printability(triplets().T.reshape(3, 5, 6)) < 1e-5
    far = torch.tensor([0.0, 0.0, 1.0]).reshape(3, 1, 1)
    by_hand = min(float((far.flatten() - one).norm()) for one in triplets())
    assert float(non_printability(far)) == pytest.approx(by_hand, abs=1e-5)


def test_the_threat_model_projects_onto_what_can_be_printed_and_says_how_far() -> None:
    loud = torch.tensor([0.0, 0.0, 1.0])[:, None, None].expand(3, 8, 8)
    anything, excess = PatchThreat().project(loud)
    assert torch.equal(anything, loud)
    assert excess == 0
    patch, excess = PatchThreat(norm="print").project(loud)
    torch.testing.assert_close(patch, printed(loud))
    assert excess == pytest.approx(float((patch - loud).abs().max()))


def test_eot_optimises_the_patch_that_can_be_printed() -> None:
    attack = EOT(texels=8, steps=10, batch=4, window=32)
    patch = crafted(attack, "print")
    assert PatchThreat(norm="print").project(patch)[1] < 1e-4
    assert PatchThreat(norm="print").project(crafted(attack, "patch"))[1] > 0.05


def test_a_weight_on_the_score_leads_to_colours_that_can_be_printed() -> None:
    free, weighed = (
        crafted(EOT(texels=8, steps=30, batch=4, window=32, tv=0, nps=nps), "patch") for nps in (0.0, 10.0)
    )
    assert non_printability(weighed) < 0.5 * non_printability(free)
