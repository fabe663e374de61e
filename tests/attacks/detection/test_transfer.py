"""The patch against other detectors: whom it asks, whom it hides the sign from, and how its parts are cut out."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from cavbench.attacks.detection.eot import CUT, EOT, cut_out
from cavbench.attacks.detection.shake_drop import branches, shake
from cavbench.attacks.detection.transfer import Transfer, Turns
from cavbench.core.pair import Pair, choose
from cavbench.detection import PatchThreat
from cavbench.detection.crafting import craft
from cavbench.detection.victims.fcos import FCOS
from cavbench.detection.victims.yolov3_tiny import YOLOv3Tiny
from cavbench.detection.victims.yolov5 import Bottleneck, YOLOv5
from cavbench.errors import UserError
from tests.attacks.detection.test_eot import SCENES
from tests.conftest import FACTS
from tests.detection.drawn_street import DrawnStreet
from tests.plugins.toy_camera import RedDetector


def crafted(attack: Transfer, seed: int = 0) -> tuple[Tensor, int]:
    made = craft(attack, RedDetector(), SCENES, PatchThreat(), attack_seed=seed, progress=lambda share, text: None)
    assert made.texels is not None
    return made.texels, made.queries


def test_the_victim_is_never_asked_and_the_patch_depends_on_the_seed_only() -> None:
    attack = Transfer(surrogates="yolov3_tiny", texels=16, steps=2, batch=2)
    (first, queries), (again, _), (other, _) = (crafted(attack, seed) for seed in (0, 0, 1))
    assert queries == 0
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_against_the_victim_itself_it_is_eot() -> None:
    """The only difference is what the question costs."""
    scenes, options = (
        DrawnStreet().training_scenes(),
        {"texels": 16, "steps": 3, "batch": 2, "window": 160, "cutout": 0.5},
    )
    attacks = Transfer(surrogates="yolov3_tiny", **options), EOT(loss="log_odds", tv=0.05, **options)
    victim = YOLOv3Tiny().load(0, FACTS)
    free, asked = (
        craft(attack, victim, scenes, PatchThreat(), attack_seed=0, progress=lambda share, text: None)
        for attack in attacks
    )
    assert torch.equal(free.texels, asked.texels)
    assert (free.queries, asked.queries) == (0, 6)
    assert free.evolution is not None


def test_surrogates_take_turns_and_each_tells_of_the_stop_sign_only() -> None:
    detectors = [YOLOv3Tiny().load(0, FACTS), YOLOv5().load(0, FACTS)]
    turns, shown = Turns(detectors), torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    for detector in (*detectors, *detectors):
        told = turns(shown)
        assert torch.equal(told.scores_of(0), detector(shown).scores_of(detector.index("stop sign")))


def test_a_run_refuses_a_victim_that_is_a_surrogate() -> None:
    parts = {"defense": choose("defense", "none"), "world": choose("world", "camera"), "threat": PatchThreat()}
    attack = choose("attack", "transfer", surrogates="fcos+yolov5")
    Pair(attack=attack, victim=choose("victim", "yolov3_tiny"), **parts)
    with pytest.raises(UserError, match=r"does not fit victim 'yolov5', which attack\.surrogates=fcos\+yolov5 names"):
        Pair(attack=attack, victim=choose("victim", "yolov5"), **parts)


def test_shaken_branches_are_scaled_by_one_factor_an_image_and_their_gradients_by_others() -> None:
    block = Bottleneck(4, shortcut=True).double().eval()
    block.requires_grad_(False)
    x = torch.rand(3000, 4, 5, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(1)).requires_grad_(True)
    wanted = block(x) - x
    assert shake(block, 0.5, torch.Generator().manual_seed(0)) == 1
    factors, gradients = [], []
    for _ in range(12):
        branch = block(x) - x
        scale = branch / wanted
        assert torch.allclose(scale, scale.mean((1, 2, 3), keepdim=True).expand_as(scale), atol=1e-3)
        factors.append(scale.mean((1, 2, 3)))
        (slope,) = torch.autograd.grad(branch.sum(), x, retain_graph=True)
        (plain,) = torch.autograd.grad(wanted.sum(), x, retain_graph=True)
        gradients.append((slope / plain).flatten(1).median(1).values)
    shaken = torch.tensor([bool((each - 1).abs().max() > 1e-3) for each in factors])
    assert 2 <= shaken.sum() <= 10
    for forwards, backwards in zip(factors, gradients, strict=True):
        if (forwards - 1).abs().max() < 1e-3:
            assert torch.allclose(backwards, torch.ones_like(backwards), atol=1e-3)
            continue
        for drawn in (forwards, backwards):
            assert 0 <= drawn.min() < 0.02
            assert 1.98 < drawn.max() <= 2.001
            assert abs(drawn.mean() - 1) < 0.06
        assert abs(torch.corrcoef(torch.stack((forwards, backwards)))[0, 1]) < 0.1


def test_shake_drop_draws_from_the_seed_and_needs_residual_branches() -> None:
    options = {"texels": 16, "steps": 2, "batch": 2, "window": 160}
    plain, shaken, again = (
        crafted(Transfer(surrogates="yolov5", shake_drop=share, **options))[0] for share in (0.0, 1.0, 1.0)
    )
    assert torch.equal(shaken, again)
    assert not torch.equal(shaken, plain)
    assert [len(list(branches(each.load(0, FACTS)))) for each in (YOLOv5(), FCOS(), YOLOv3Tiny())] == [7, 7, 0]
    with pytest.raises(UserError, match=r"attack\.shake_drop=0\.5: yolov3_tiny has no residual branches"):
        crafted(Transfer(surrogates="yolov3_tiny", shake_drop=0.5, **options))


@pytest.mark.parametrize(
    ("surrogates", "said"), [("yolov3_tiny+dqn", "DQN is no detector"), ("yolov9", "unknown victim 'yolov9'")]
)
def test_what_is_no_detector_is_refused_in_one_line(surrogates: str, said: str) -> None:
    with pytest.raises(UserError, match=said):
        crafted(Transfer(surrogates=surrogates))


def test_a_cut_out_square_is_grey_and_the_rest_is_the_patch() -> None:
    patch = torch.zeros(1, 3, 20, 20)
    views = cut_out(patch, 50, 1.0, torch.Generator().manual_seed(0))
    assert views.shape == (50, 3, 20, 20)
    assert set(views.unique().tolist()) == {0.0, 0.5}
    assert ((views == 0.5).sum((1, 2, 3)) == 3 * round(20 * CUT) ** 2).all()
    assert len({tuple(view[0].nonzero()[0].tolist()) for view in views}) > 20
    some = cut_out(patch, 400, 0.25, torch.Generator().manual_seed(0)).amax((1, 2, 3)) > 0
    assert 0.15 < some.float().mean() < 0.35
    leaf = torch.rand(1, 3, 20, 20).requires_grad_(True)
    cut_out(leaf, 1, 1.0, torch.Generator().manual_seed(0)).sum().backward()
    assert (leaf.grad == 0).sum() == 3 * round(20 * CUT) ** 2
