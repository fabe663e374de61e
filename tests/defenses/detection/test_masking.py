"""Masking: a judge that does not see the middle of a window, its certificate, the training, and the shipped judge."""

from __future__ import annotations

from functools import cache, partial
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import load_file
from torch import Tensor

from cavbench import zoo
from cavbench.attacks.detection.eot import EOT
from cavbench.defenses.detection import masking
from cavbench.defenses.detection.jpeg import JPEG
from cavbench.defenses.detection.judge import (
    ACROSS,
    CELL,
    COVER,
    HIDDEN,
    LEVELS,
    NEVER,
    STEP,
    UNLIKELY,
    WINDOW,
    Judge,
    best_of_blocks,
    bound,
    levels,
)
from cavbench.defenses.detection.masking import Masked, Masking
from cavbench.defenses.detection.temporal import TemporalFusion
from cavbench.detection import Scenes
from cavbench.detection.approach import score
from cavbench.detection.boxes import confidence
from cavbench.detection.crafting import craft
from cavbench.detection.patch import Patch
from cavbench.detection.placed import Placed
from cavbench.detection.sight import certain, look
from cavbench.detection.threat import PatchThreat
from cavbench.detection.victims.yolov3_tiny import YOLOv3Tiny
from cavbench.detection.victims.yolov5 import YOLOv5
from cavbench.envs.camera.windscreen import Windscreen
from cavbench.envs.camera.world import StopSignApproach
from cavbench.errors import UserError
from tests.detection.drawn_street import DrawnStreet
from tests.plugins.toy_camera import RedDetector, RedScenes, RedStreet, RedVictim

FACTS = StopSignApproach().facts
QUICK = Masking(updates=2, batch=3, trained_in="DrawnStreet")
SHARE = 0.5
SILENT = partial(lambda *_: None)


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


@cache
def untrained() -> Judge:
    torch.manual_seed(0)
    judge = Judge().eval()
    # Chance log-odds are close to 0 everywhere; these differ, and every window is looked at twice.
    judge.joined.weight.data *= 20
    judge.glance.bias.data += 20
    return judge.requires_grad_(False)


@cache
def scenes(world: type[Any] = StopSignApproach, **cell: object) -> Scenes:
    made = world()
    (approach,) = made.approaches(made.axes.cell(**{"lanes": 3, "density": 1.0, "weather": "clear", **cell}), range(1))
    found: Scenes = approach.scenes
    return found


@cache
def shipped() -> Masked:
    detector = Masking().load(YOLOv3Tiny(), 0, FACTS)
    assert isinstance(detector, Masked)
    return detector


def test_a_window_is_judged_by_its_rim_alone() -> None:
    window = random(1, 3, WINDOW, WINDOW).requires_grad_(True)
    edge = (WINDOW - COVER) // 2
    for odds in (untrained()(window), *untrained().both(window)):
        assert odds.shape == (1, 1, 1, 1)
        (gradient,) = torch.autograd.grad(odds.sum(), window, retain_graph=True)
        looked_at = gradient.abs().amax((0, 1)) > 0
        assert not looked_at[edge:-edge, edge:-edge].any()
        looked_at[edge:-edge, edge:-edge] = True
        assert looked_at.all()
    assert ACROSS * CELL == WINDOW
    assert HIDDEN * CELL == COVER


def test_only_likely_windows_are_looked_at_twice_and_then_as_in_the_training() -> None:
    torch.manual_seed(1)
    judge, shown = Judge().eval().requires_grad_(False), random(2, 3, 90, 110)
    judge.glance.bias.data += UNLIKELY - judge.both(shown)[0].median()
    (at_a_glance, better), found = judge.both(shown), judge(shown)
    likely = at_a_glance > UNLIKELY
    assert 0 < likely.float().mean() < 1
    assert torch.allclose(found[likely], better[likely], atol=1e-5)
    assert (found[~likely] == NEVER).all()


def at(covers: Tensor, place: float) -> tuple[int, int, list[int]]:
    """A window [row, column] of a level, and the pixels of the image in its cover: x0, y0, x1, y1."""
    number = int(place * covers.shape[0] * covers.shape[1])
    row, column = divmod(number, covers.shape[1])
    x0, y0, x1, y1 = covers[row, column].clamp(min=0).tolist()
    return row, column, [-int(-x0 // 1), -int(-y0 // 1), int(x1), int(y1)]


@settings(max_examples=60, deadline=None)
@given(
    number=st.integers(0, LEVELS - 1),
    across=st.floats(0, 0.999),
    width=st.integers(120, 333),
    seed=st.integers(0, 99),
)
def test_what_the_cover_hides_in_the_image_has_no_influence(number: int, across: float, width: int, seed: int) -> None:
    shown, other = random(1, 3, 384, width, seed=seed), random(1, 3, 384, width, seed=seed + 100)
    level = list(levels(shown))[number]
    row, column, (x0, y0, x1, y1) = at(level.covers, across)
    changed = shown.clone()
    changed[..., y0:y1, x0:x1] = other[..., y0:y1, x0:x1]
    after = list(levels(changed))[number]
    part = (..., slice(STEP * row, STEP * row + WINDOW), slice(STEP * column, STEP * column + WINDOW))
    one, two = (float(untrained()(each.pictures[part])) for each in (level, after))
    assert two == pytest.approx(one, abs=1e-4)


def test_the_bound_is_the_best_certain_window_of_a_block_that_is_all_at_the_sign() -> None:
    odds = torch.tensor([[1.0, 2, 9, 9, 3], [0, 0, 9, 9, 4]])[None, None]
    boxes = random(2, 5, 4)
    best, where = best_of_blocks(odds, boxes)
    assert best.tolist() == [[9, 4]]
    assert torch.equal(where, torch.stack([boxes[0, 2], boxes[1, 4]])[None])
    usable, found = torch.zeros(1, 2, 5, dtype=torch.bool), torch.ones(1, 2, 5, dtype=torch.bool)
    assert bound(odds, usable, found).tolist() == [-torch.inf]
    usable[0, 0, 1] = usable[0, 0, 4] = True
    assert bound(odds, usable, found).tolist() == [3]
    found[0, 1, 4] = False
    assert bound(odds, usable, found).tolist() == [2]


def test_the_detectors_own_predictions_are_kept_and_small_images_have_no_window() -> None:
    inner, shown = RedVictim().load(0, RedStreet().facts), random(2, 3, 64, 72)
    own, both = inner(shown), Masked(inner, untrained())(shown)
    known = own.boxes.shape[1]
    assert torch.equal(both.scores[:, :known], own.scores)
    assert torch.equal(both.boxes[:, :known], own.boxes)
    assert both.boxes.shape[1] > known
    assert both.scores[:, known:, 0].max() == 0
    tiny = random(1, 3, 16, 16)
    assert torch.equal(Masked(inner, untrained())(tiny).scores, inner(tiny).scores)
    assert Masked(inner, untrained()).certified(tiny, torch.zeros(1, 4), torch.zeros(1, 4)).tolist() == [0]  # type: ignore[union-attr]


@cache
def patches() -> dict[str, Tensor]:
    """Patches of all kinds, among them one that was optimised against the shipped judge."""
    board = torch.zeros(3, 16, 16)
    board[:, ::2, ::2] = board[:, 1::2, 1::2] = 1
    attack = EOT(steps=4, batch=2, window=160, texels=32, loss="log_odds", learning_rate=0.3)
    threat = PatchThreat(budget=SHARE)
    training = StopSignApproach().training_scenes()
    made = craft(attack, shipped(), training, threat, attack_seed=0, progress=lambda share, text: None).texels
    assert made is not None
    red = torch.tensor([0.68, 0.08, 0.12])[:, None, None].expand(3, 16, 16)
    return {
        "noise": random(3, 64, 64),
        "white": torch.ones(3, 8, 8),
        "black": torch.zeros(3, 8, 8),
        "red": red,
        "board": board,
        "eot": made,
    }


@pytest.mark.parametrize("weather", ["clear", "rain"])
def test_no_patch_lowers_the_confidence_below_the_certificate(weather: str) -> None:
    frames = scenes(weather=weather)
    least = certain(shipped(), frames, SHARE)
    assert least is not None
    assert least.mean() > 0.3
    for texels in patches().values():
        assert (look(shipped(), frames, texels, SHARE).confidence >= least - 1e-4).all()


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10**6), texels=st.integers(8, 100), frame=st.integers(0, 9))
def test_no_random_patch_changes_what_is_certain(seed: int, texels: int, frame: int) -> None:
    frames, one = scenes(), torch.tensor([frame])
    patch = random(1, 3, texels, texels, seed=seed)
    place, reach = frames.boxes[one], frames.reach(SHARE)[one]
    bare, patched = (frames.render(one, each, SHARE) for each in (None, patch))
    without, with_ = (shipped().certified(picture, place, reach) for picture in (bare, patched))
    assert without is not None
    assert torch.allclose(without, with_, atol=1e-5)  # type: ignore[arg-type]


def test_a_larger_patch_has_no_certificate() -> None:
    frames = scenes()
    for share, most in ((0.8, 0.02), (1.0, 0.001)):
        least = certain(shipped(), frames, share)
        assert least is not None
        assert least.mean() <= most


def test_beside_the_middle_less_is_certain_and_that_holds() -> None:
    frames = scenes()
    every, noise = torch.arange(len(frames)), random(3, *frames.size)
    wide = (frames.boxes[:, 2] - frames.boxes[:, 0])[:, None]
    shown, middle = frames.render(every, None, SHARE), certain(shipped(), frames, SHARE)
    beside = (frames.reach(SHARE) + 0.35 * wide * torch.tensor([1.0, 0.0, 1.0, 0.0])).round()
    least = shipped().certified(shown, frames.boxes, beside)
    assert least is not None
    assert middle is not None
    assert least.mean() < middle.mean() - 0.3
    for picture, (x0, y0, x1, y1) in zip(shown, beside.int().tolist(), strict=True):
        picture[:, y0:y1, x0:x1] = noise[:, y0:y1, x0:x1]
    attacked = confidence(shipped()(shown), shipped().label, frames.boxes)
    assert (attacked >= least - 1e-4).all()


def test_drops_that_spread_the_patch_over_the_image_leave_no_certificate() -> None:
    least = certain(shipped(), scenes(Windscreen, lens="drops"), SHARE)
    assert least is not None
    assert least.max() == 0


def test_a_memory_and_a_filter_in_front_end_the_certificate_and_another_device_keeps_it() -> None:
    victim, shown = RedVictim(), random(1, 3, 64, 64)
    place = torch.tensor([[10.0, 10, 40, 40]]), torch.tensor([[20.0, 20, 30, 30]])
    inner = victim.load(0, RedStreet().facts)
    masked = Masked(inner, untrained())
    least = masked.certified(shown, *place)
    assert least is not None
    assert least > 0
    assert Masked(TemporalFusion().around(inner), untrained()).certified(shown, *place) is None
    assert TemporalFusion().around(masked).certified(shown, *place) is None
    assert inner.certified(shown, *place) is None
    assert JPEG().load(YOLOv3Tiny(), 0, FACTS).certified(shown, *place) is None
    again = Placed(masked, "cpu").certified(shown, *place)
    assert again is not None
    assert torch.equal(again, least)


class Promising(RedDetector):
    """Promises more than it keeps."""

    def __init__(self, promise: float) -> None:
        super().__init__()
        self.promise = promise

    def certified(self, pictures: Tensor, boxes: Tensor, reach: Tensor) -> Tensor:
        return torch.full((len(pictures),), self.promise)


def test_the_certificate_is_a_column_and_a_false_one_ends_the_run() -> None:
    (approach,) = RedStreet().approaches(RedStreet.axes.cell(lanes=3, density=1.0, weather="clear"), range(1))
    run = partial(score, approaches=[approach], patch=Patch(torch.zeros(3, 8, 8)), share=SHARE)
    kept = run(Promising(0.3))
    assert kept["certified"] == pytest.approx(0.3 - kept["decoy_confidence"], abs=1e-6)
    assert (kept["certified"] <= kept["stop_score"]).all()
    assert kept["frame_certified"].tolist() == [pytest.approx([0.3] * len(approach.scenes))]
    assert torch.tensor(run(RedDetector())["certified"]).isnan().all()
    assert torch.tensor(run(Promising(0.3), patch=None, share=0.0)["certified"]).isnan().all()
    assert isinstance(approach.scenes, RedScenes)
    with pytest.raises(UserError, match="the certificate is false"):
        run(Promising(0.95))


def test_it_trains_the_judge_only_the_zoo_finds_it_and_all_victims_get_the_same_one(
    victim: YOLOv5, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path / "zoo"))
    monkeypatch.setattr(masking, "LOOKED_AT", 6)
    made, other = (
        QUICK.train(one, DrawnStreet(), seed=0, progress=lambda share, text: None) for one in (victim, RedVictim())
    )
    recipe = zoo.Recipe.of(victim, QUICK)
    path = zoo.save(made.network, recipe, seed=0, world=DrawnStreet(), card=made.card, start=made.start)
    assert all(name.startswith("judge.") for name in load_file(path))
    shown = random(1, 3, 64, 64)
    again = QUICK.load(victim, 7, FACTS)
    assert torch.allclose(again(shown).scores, made.network(shown).scores, rtol=0.02, atol=1e-3)
    judges = [each.network.judge.parameters() for each in (made, other)]  # type: ignore[union-attr]
    assert all(map(torch.equal, *judges))


def test_impossible_options_are_refused() -> None:
    for bad in ({"updates": 0}, {"batch": 0}, {"learning_rate": 0.0}, {"trained": -1}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            Masking(**bad)  # type: ignore[arg-type]
