"""EOT: its loss, its randomness, and its query budget."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from cavbench.attacks.detection.eot import EOT, total_variation
from cavbench.attacks.detection.grey_patch import GreyPatch
from cavbench.attacks.detection.noise_patch import NoisePatch
from cavbench.attacks.detection.views import corners
from cavbench.detection import Detector, PatchOracle, PatchThreat, Predictions, Scenes
from cavbench.detection.access import PatchEnforcer
from cavbench.detection.boxes import confidence
from cavbench.detection.victims.yolov3_tiny import YOLOv3TinyNetwork
from cavbench.errors import UserError
from tests.detection.drawn_street import DrawnStreet
from tests.plugins.toy_camera import SIGN, RedDetector, RedScenes

SCENES = RedScenes(torch.linspace(30, 8, 5))


def crafted(
    attack: EOT | NoisePatch | GreyPatch,
    seed: int = 0,
    queries: int = 20_000,
    detector: Detector | None = None,
    scenes: Scenes | None = None,
) -> tuple[Tensor, PatchOracle]:
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    oracle = PatchEnforcer(detector or RedDetector(), PatchThreat(queries=queries), attack.access, generator).oracle
    scenes = scenes or (SCENES if detector is None else DrawnStreet().training_scenes())
    return attack.craft(oracle, scenes, lambda share, text: None), oracle


def red(patch: Tensor) -> float:
    """Mean confidence with a patch on the sign."""
    shown = SCENES.render(torch.arange(len(SCENES)), patch.unsqueeze(0), 0.5)
    return float(confidence(RedDetector()(shown), 1, SCENES.boxes).mean())


def test_the_patch_is_close_to_the_optimum() -> None:
    """The toy detector measures red, so the best patch is cyan."""
    patch, oracle = crafted(EOT(texels=16, steps=40, batch=4, window=32))
    assert patch.shape == (3, 16, 16)
    assert 0 <= patch.min() <= patch.max() <= 1
    assert (oracle.spent, oracle._enforcer.backwards) == (160, 160)
    best = red(torch.tensor([0.0, 1.0, 1.0])[:, None, None].expand(3, 8, 8))
    controls = [red(crafted(control)[0]) for control in (NoisePatch(texels=16), GreyPatch())]
    assert best <= red(patch) < best + 0.1 * (min(controls) - best)


def test_the_patch_depends_on_the_seed_only() -> None:
    attack = EOT(texels=8, steps=3, batch=2, window=32)
    first, again, other = (crafted(attack, seed)[0] for seed in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_log_odds_lead_to_the_optimum_too() -> None:
    plain, odds = (
        crafted(EOT(texels=8, steps=30, batch=4, window=32, loss=loss))[0] for loss in ("probability", "log_odds")
    )
    assert red(odds) <= red(plain) + 0.05


def test_log_odds_keep_the_gradient_where_the_detector_is_sure() -> None:
    scores = torch.tensor([0.9999, 0.5], requires_grad=True)
    (gradient,) = torch.autograd.grad(EOT(loss="log_odds")._loss(scores), scores)
    assert gradient[0] > 1000 * gradient[1]


def test_of_several_starts_the_best_is_kept() -> None:
    """The first start of three is the only start of one: with more starts, the patch hides the sign at least as well."""
    several, oracle = crafted(EOT(texels=8, steps=4, batch=4, window=32, restarts=3))
    assert oracle.spent == 3 * 4 * 4
    single = crafted(EOT(texels=8, steps=4, batch=4, window=32))[0]
    assert red(several) <= red(single) + 0.02


def test_a_start_without_the_queries_for_it_is_not_kept() -> None:
    attack = EOT(texels=8, steps=10, batch=4, window=32, restarts=2)
    patch, oracle = crafted(attack, queries=60)
    assert oracle.spent == 60
    assert torch.equal(patch, crafted(EOT(texels=8, steps=10, batch=4, window=32))[0])


def test_it_reports_its_losses_without_changing_the_patch(monkeypatch: pytest.MonkeyPatch) -> None:
    attack = EOT(texels=8, steps=6, batch=2, window=32)
    patch, oracle = crafted(attack)
    reported = oracle.reports.evolution
    assert reported is not None
    assert set(reported.losses) == {"found", "total_variation"}
    variation = torch.stack([total_variation(texels / 255) for texels in reported.texels])
    assert torch.allclose(reported.losses["total_variation"], variation, atol=0.01)
    monkeypatch.setattr(PatchOracle, "report", lambda *_, **__: None)
    assert torch.equal(crafted(attack)[0], patch)


class Dragged(RedDetector):
    """The stop sign's score is always 0.9; its box is the farther to the right, the bluer the sign is."""

    def predict(self, pictures: Tensor) -> Predictions:
        blueness = pictures[:, 2, SIGN, SIGN].mean((1, 2))
        shift = torch.tensor([1.0, 0.0, 1.0, 0.0]) * 24 * blueness[:, None]
        boxes = (torch.tensor([8.0, 8.0, 24.0, 24.0]) + shift)[:, None]
        classes = torch.tensor([0.0, 1.0]).expand(len(pictures), 1, 2)
        return Predictions(boxes, torch.full_like(blueness[:, None], 0.9), classes)


def test_a_box_may_be_moved_away() -> None:
    plain = EOT(
        texels=8, steps=60, batch=4, window=32, translation=0.0, rotation=0.0, scale=0.0, perspective=0.0, tv=0.0
    )
    moving = replace(plain, moves=True, loss="log_odds")
    blue = [float(crafted(attack, detector=Dragged(), scenes=SCENES)[0][2].mean()) for attack in (plain, moving)]
    assert blue[0] < 0.6
    assert blue[1] > 0.9


def test_a_search_ends_on_a_plateau_and_goes_on_while_the_loss_falls() -> None:
    flat = EOT(texels=8, steps=200, batch=2, window=32, patience=10, tv=0.0)
    _, oracle = crafted(flat, detector=Dragged(), scenes=SCENES)
    assert oracle.spent < 60
    falling = EOT(texels=8, steps=200, batch=4, window=32, patience=10, learning_rate=0.01)
    patch, oracle = crafted(falling)
    assert 4 * 30 < oracle.spent < 4 * 200
    assert red(patch) <= red(crafted(replace(falling, patience=0, steps=30))[0])


class TwoColours(RedDetector):
    """Red boxes are stop signs, blue ones are cars."""

    def predict(self, pictures: Tensor) -> Predictions:
        found = super().predict(pictures)
        blue = super().predict(pictures.flip(1))
        return Predictions(
            found.boxes, torch.ones_like(found.objectness), torch.stack((blue.objectness, found.objectness), -1)
        )


def test_a_target_is_seen_instead() -> None:
    def seen(attack: EOT) -> tuple[Tensor, float]:
        patch = crafted(attack, detector=TwoColours(), scenes=SCENES)[0]
        shown = SCENES.render(torch.arange(len(SCENES)), patch.unsqueeze(0), 0.5)
        return patch, float(confidence(TwoColours()(shown), 0, SCENES.boxes).mean())

    common = EOT(texels=8, steps=40, batch=4, window=32, tv=0, loss="log_odds")
    hidden, aimed = (seen(replace(common, target=target)) for target in ("", "car"))
    assert aimed[1] > 1.2 * hidden[1]
    # Green hides the sign, but makes no car of it.
    assert aimed[0][2].mean() > 0.8
    assert aimed[0][0].mean() < 0.2
    assert aimed[0][1].mean() < hidden[0][1].mean() - 0.2
    with pytest.raises(UserError, match="unknown class 'bus'; known: car, stop sign"):
        crafted(EOT(texels=8, steps=1, batch=1, window=32, target="bus"))


def test_a_window_that_the_detector_does_not_take_is_refused() -> None:
    coarse = RedDetector()
    coarse.stride = 32
    with pytest.raises(UserError, match=r"attack\.window=100: .* multiples of 32 .*, for instance 96"):
        crafted(EOT(texels=8, steps=1, batch=1, window=100), detector=coarse)


def test_it_stops_at_the_query_budget() -> None:
    _, oracle = crafted(EOT(texels=8, steps=100, batch=8, window=32), queries=30)
    assert oracle.spent == 24


@settings(max_examples=50, deadline=None)
@given(
    x=st.floats(0, 1200),
    y=st.floats(0, 340),
    side=st.floats(5, 100),
    translation=st.floats(0, 0.3),
    seed=st.integers(0, 99),
)
def test_the_window_contains_the_sign(x: float, y: float, side: float, translation: float, seed: int) -> None:
    box = torch.tensor([[x, y, min(x + side, 1248), min(y + side, 384)]])
    generator = torch.Generator().manual_seed(seed)
    (corner,) = corners(box, (384, 1248), 320, translation, generator)
    assert 0 <= corner[0] <= box[0, 0]
    assert 0 <= corner[1] <= box[0, 1]
    assert box[0, 2] <= corner[0] + 320 <= 1248
    assert box[0, 3] <= corner[1] + 320 <= 384


def test_total_variation_is_zero_for_a_plain_patch_and_largest_for_a_chessboard() -> None:
    chessboard = (torch.arange(8)[:, None] + torch.arange(8)) % 2
    assert total_variation(torch.full((1, 3, 8, 8), 0.3)) == 0
    assert total_variation(chessboard.float().expand(1, 3, 8, 8)) == 2


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("texels", 7),
        ("steps", 0),
        ("learning_rate", 0.0),
        ("tv", -1.0),
        ("hue", 0.6),
        ("scale", 1.0),
        ("rotation", -1.0),
    ],
)
def test_a_parameter_out_of_range_is_named(name: str, value: float) -> None:
    assert name in {field.name for field in fields(EOT)}
    with pytest.raises(ValueError, match=rf"{name} must be"):
        EOT(**{name: value})  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_real_detector_misses_the_sign(published: YOLOv3TinyNetwork) -> None:
    """Tested on the crafting frames: checks only that the gradient reaches the patch."""
    detector = published
    scenes = DrawnStreet().training_scenes()
    attack = EOT(texels=32, steps=30, batch=4)
    found = []
    for patch in (crafted(attack, detector=detector)[0], crafted(NoisePatch(texels=32), detector=detector)[0]):
        with torch.no_grad():
            shown = scenes.render(torch.arange(len(scenes)), patch.unsqueeze(0), 0.5)
            found.append(float(confidence(detector(shown), detector.index("stop sign"), scenes.boxes).mean()))
    assert found[0] < 0.5 * found[1]
