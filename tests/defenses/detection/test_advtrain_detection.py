"""Adversarial training of detectors: its training data, its side effects, and the robustness of the shipped detector."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from cavbench import zoo
from cavbench.attacks.detection.eot import EOT
from cavbench.attacks.detection.noise_patch import NoisePatch
from cavbench.core.contracts import Facts
from cavbench.defenses.detection.advtrain_detection import DetectorAdversarialTraining, _Hardening
from cavbench.detection import STOP_SIGN, Detector, DetectorVictim, PatchThreat, Predictions
from cavbench.detection.access import PatchEnforcer
from cavbench.detection.boxes import confidence
from cavbench.detection.sight import look, look_at_decoys
from cavbench.detection.victims.examples import Example
from cavbench.detection.victims.rcnn import RCNN, RCNNNetwork
from cavbench.detection.victims.yolov3_tiny import YOLOv3Tiny, YOLOv3TinyNetwork
from cavbench.detection.victims.yolov5 import YOLOv5, YOLOv5Network
from cavbench.envs.camera.bank import TrainingScenes
from cavbench.envs.camera.world import StopSignApproach
from cavbench.errors import UserError
from cavbench.run.config import component, plan_of
from tests.detection.drawn_street import DrawnStreet
from tests.plugins.toy_camera import SIGN, RedDetector, RedStreet

FACTS = StopSignApproach().facts
QUICK = {"rounds": 2, "updates": 2, "batch": 2, "attack_params": "steps=2 batch=2 window=224"}


LARGEST = 20_000


def trained(victim: YOLOv5, **params: object) -> tuple[Detector, list[str]]:
    told: list[str] = []
    defense = DetectorAdversarialTraining(**{**QUICK, **params})
    made = defense.train(victim, DrawnStreet(), seed=0, progress=lambda share, text: told.append(text))
    return made.network, told


def test_it_trains_the_given_detector_and_the_zoo_finds_it(
    victim: YOLOv5, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path / "zoo"))
    before, pictures = victim.load(0, FACTS), torch.rand(1, 3, 64, 64)
    defense = DetectorAdversarialTraining(**QUICK, largest=LARGEST, trained_in="DrawnStreet")
    made = defense.train(victim, DrawnStreet(), seed=0, progress=lambda share, text: None)
    assert all(
        torch.equal(a, b)
        for a, b in zip(before.state_dict().values(), victim.load(0, FACTS).state_dict().values(), strict=True)
    )
    recipe = zoo.Recipe.of(victim, defense)
    path = zoo.save(made.network, recipe, seed=0, world=DrawnStreet(), card=made.card, start=made.start)
    small = {name for name, weight in before.named_parameters() if weight.numel() <= LARGEST}
    assert load_file(path).keys() == small < before.state_dict().keys()
    again = defense.load(victim, 5, FACTS)
    torch.testing.assert_close(again(pictures).scores, made.network(pictures).scores, rtol=0.02, atol=1e-3)
    assert not torch.equal(again(pictures).scores, before(pictures).scores)
    assert not any(weight.requires_grad for weight in again.parameters())
    with pytest.raises(UserError, match=r"defense\.rounds=3.*of training seed 0.*defense\.rounds=2"):
        replace(defense, rounds=3).load(victim, 0, FACTS)
    with pytest.raises(
        UserError, match=r"of training seed 1.*To train it: `bench train victim=yolov5 defense=advtrain"
    ):
        replace(defense, trained=1).load(victim, 0, FACTS)


def test_training_depends_on_the_seed_and_the_control_is_never_attacked(victim: YOLOv5) -> None:
    (one, told), (again, _), (control, untold) = trained(victim), trained(victim), trained(victim, skip=1.0)
    assert all(torch.equal(a, b) for a, b in zip(one.state_dict().values(), again.state_dict().values(), strict=True))
    assert any(text.startswith("patch 2, ") for text in told)
    assert not any(text.startswith("patch") for text in untold)
    assert not torch.equal(one.state_dict()["model.24.m.0.weight"], control.state_dict()["model.24.m.0.weight"])


class FewScenes(StopSignApproach):
    """Has twelve frames to learn from."""

    def training_scenes(self) -> TrainingScenes:
        all_scenes = super().training_scenes()
        frames = list(zip(all_scenes.poses, all_scenes.frames, strict=True))[::9]
        return TrainingScenes(frames, all_scenes.weathers[::9])


@pytest.mark.slow
def test_a_detector_that_is_not_aligned_learns_from_what_it_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    victim, shown, own = RCNN(), [], RCNN.loss

    def watched(self: RCNN, network: RCNNNetwork, example: Example) -> Tensor:
        shown.append(example)
        return own(self, network, example)

    monkeypatch.setattr(RCNN, "loss", watched)
    for decoys in (0.0, 1.0):
        defense = DetectorAdversarialTraining(rounds=1, updates=3, batch=4, skip=1.0, decoys=decoys)
        made = defense.train(victim, FewScenes(), seed=0, progress=lambda share, text: None)
        assert not torch.equal(
            made.network.state_dict()["second.name.bias"], made.start.state_dict()["second.name.bias"]
        )
    sign = victim.load(0, FACTS).index(STOP_SIGN)
    real, false = (
        [int((label == sign).sum()) for one in part for label in one.labels] for part in (shown[:3], shown[3:])
    )
    assert sum(real) > len(real) // 2
    assert sum(false) == 0 < sum(len(label) for one in shown[3:] for label in one.labels)


@pytest.mark.parametrize("decoys", [0.0, 1.0])
def test_decoys_carry_the_patches_that_signs_carry(decoys: float, victim: YOLOv5) -> None:
    scenes = FewScenes().training_scenes()
    recipe = DetectorAdversarialTraining(skip=0.0, decoys=decoys, window=64)
    start = victim.load(0, FACTS)
    hardening = _Hardening(recipe, NoisePatch(), victim, start, scenes, seed=0, progress=lambda share, text: None)
    hardening._begin(0)
    views = hardening.windows.draw(16)
    signs, plain = hardening._plain(views)
    shown = hardening._patched(views, plain, signs)
    signed = hardening.windows.cut(views, scenes.render(views.frames, hardening.patches[0][None], recipe.budget))
    assert signs.all() == (not decoys)
    if not decoys:
        torch.testing.assert_close(shown, signed)
        return
    boxes = views.boxes(scenes.reach(recipe.budget)[views.frames], recipe.window).int().tolist()
    seen = 0
    for after, before, like, (left, top, right, bottom) in zip(shown, plain, signed, boxes, strict=True):
        changed = (after != before).any(0)
        torch.testing.assert_close(after[:, changed], like[:, changed])
        seen += int(changed.sum())
        changed[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)] = False
        assert not changed.any()
    assert seen > 1000


def test_a_patch_never_hides_another_word_and_foreign_stop_signs_are_to_be_found(victim: YOLOv5) -> None:
    recipe = DetectorAdversarialTraining(skip=0.0, decoys=1.0, window=64, faces="signs")
    scenes = FewScenes().training_scenes()
    hardening = _Hardening(
        recipe, NoisePatch(), victim, victim.load(0, FACTS), scenes, seed=0, progress=lambda share, text: None
    )
    hardening._begin(0)
    views = hardening.windows.draw(64)
    signs, plain = hardening._plain(views)
    changed = (hardening._patched(views, plain, signs) != plain).flatten(1).any(1)
    words = hardening.of_family(views, "words")
    assert not changed[words].any()
    assert changed[~words].any()
    assert words.any()
    places, foreign = torch.rand(4, 4), torch.tensor([True, False, True, False])
    taught = hardening._taught(plain[:4], hardening.teacher(plain[:4]), signs[:4], foreign, places)
    stops = [int((label == hardening.label).sum()) for label in taught.labels]
    assert stops == foreign.int().tolist()
    torch.testing.assert_close(taught.boxes[0][-1], places[0])


def test_a_training_that_was_stopped_ends_as_one_that_was_not(
    victim: YOLOv5, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path))
    whole, _ = trained(victim)

    class StoppedError(Exception):
        """As if the machine went down."""

    def stopping(share: float, text: str) -> None:
        if text.startswith("patch 2"):
            raise StoppedError

    defense = DetectorAdversarialTraining(**QUICK)
    with pytest.raises(StoppedError):
        defense.train(victim, DrawnStreet(), seed=0, progress=stopping)
    path = zoo.unfinished(zoo.Recipe.of(victim, defense), 0)
    assert path.exists()
    again, told = trained(victim)
    assert not any(text.startswith("patch 1") for text in told)
    assert not path.exists()
    assert all(torch.equal(a, b) for a, b in zip(whole.state_dict().values(), again.state_dict().values(), strict=True))
    path.write_bytes(b"cut short")
    with pytest.raises(UserError, match=r"cannot be continued.*delete it"):
        trained(victim)


@pytest.mark.parametrize("of_victim", [0.0, 3.0])
def test_an_aligned_detector_that_was_trained_here_keeps_its_own_loss_too(
    of_victim: float, victim: YOLOv5, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown, weights, own = [], [], YOLOv5.loss

    def watched(self: YOLOv5, network: YOLOv5Network, example: Example) -> Tensor:
        shown.append(example)
        return own(self, network, example)

    def begun(self: _Hardening, number: int) -> None:
        weights.append(self.caution)

    monkeypatch.setattr(YOLOv5, "loss", watched)
    monkeypatch.setattr(_Hardening, "_begin", begun)
    assert victim.load(0, FACTS).aligned
    trained(replace(victim, caution=of_victim), rounds=1, updates=3, skip=1.0, caution=2.0)
    assert len(shown) == 3
    assert weights == [2.0 * (1 + of_victim)]


class NotAligned(RedDetector):
    """Has no loss of its own either."""

    aligned = False


@dataclass(frozen=True, kw_only=True)
class NotAlignedVictim(DetectorVictim):
    """The victim of `NotAligned`."""

    def load(self, seed: int, facts: Facts) -> Detector:
        return NotAligned()


def test_a_detector_that_is_not_aligned_and_has_no_loss_is_refused() -> None:
    defense = DetectorAdversarialTraining(**QUICK)
    with pytest.raises(UserError, match="NotAlignedVictim has no loss for adversarial training"):
        defense.train(NotAlignedVictim(), RedStreet(), seed=0, progress=lambda share, text: None)


class Coloured(RedDetector):
    """Takes red and green squares for stop signs, until it learns which colour is one."""

    def __init__(self) -> None:
        super().__init__()
        self.colour = nn.Linear(3, 1)
        self.colour.weight.data = torch.tensor([[4.0, 4.0, -4.0]])
        self.colour.bias.data = torch.tensor([-1.5])

    def predict(self, pictures: Tensor) -> Predictions:
        found = super().predict(pictures)
        middle, corner = pictures[:, :, SIGN, SIGN], pictures[:, :, :8, :8]
        seen = torch.stack([self.colour(part.mean((2, 3)))[:, 0] for part in (middle, corner)], 1)
        return Predictions(found.boxes, seen.sigmoid(), found.classes)


@dataclass(frozen=True, kw_only=True)
class ColouredVictim(DetectorVictim):
    """The victim of `Coloured`."""

    def load(self, seed: int, facts: Facts) -> Detector:
        return Coloured().requires_grad_(False).eval()


def test_decoys_in_the_loop_lower_the_confidence_in_decoys_and_not_in_the_sign() -> None:
    street, kept = RedStreet(), {}
    (approach,) = street.approaches(street.axes.cell(lanes=3, density=1.0, weather="clear"), range(1))
    for share in (0.0, 0.5):
        defense = DetectorAdversarialTraining(
            decoys=share,
            rounds=2,
            updates=50,
            window=32,
            learning_rate=0.3,
            caution=0.5,
            attack_params="steps=3 batch=2 window=32",
        )
        made = defense.train(ColouredVictim(), street, seed=0, progress=lambda share, text: None)
        with torch.no_grad():
            decoys = look_at_decoys(made.network, approach.scenes)
            kept[share] = look(made.network, approach.scenes, None, 0.5).confidence.mean(), decoys.confidence.mean()
    (sign, fooled), (of_sign, of_decoys) = kept[0.0], kept[0.5]
    assert of_decoys < fooled - 0.1
    assert of_sign > of_decoys + 0.5
    assert of_sign > sign - 0.1


def test_impossible_options_are_refused_in_one_line(victim: YOLOv5) -> None:
    for bad in ({"skip": 1.5}, {"rounds": 0}, {"learning_rate": 0.0}, {"budget": 2.0}, {"fidelity": -1.0}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            DetectorAdversarialTraining(**bad)
    with pytest.raises(UserError, match="largest=1 leaves no tensor of the detector to train"):
        trained(victim, largest=1)
    with pytest.raises(UserError, match="makes no patches"):
        trained(victim, attack="zo", attack_params="")
    with pytest.raises(UserError, match=r"attack_params takes name=value pairs, .*, got 'steps'"):
        trained(victim, attack_params="steps")


def test_one_name_selects_the_defence_of_each_track() -> None:
    driving = plan_of(["defense=advtrain", "victim=dqn"]).pairs[0]
    detection = plan_of(["defense=advtrain", "victim=yolov3_tiny"]).pairs[0]
    assert (driving.defense.name, detection.defense.name) == ("advtrain", "advtrain_detection")
    assert component("defense", "advtrain_detection", {"skip": "0.5"}).skip == 0.5
    with pytest.raises(UserError, match="does not fit victim 'dqn'"):
        plan_of(["defense=advtrain_detection", "victim=dqn"])


@pytest.mark.slow
def test_the_shipped_detector_withstands_patches_that_hide_the_sign_from_the_undefended_one(
    published: YOLOv3TinyNetwork,
) -> None:
    """Patches are crafted against each detector on the training places, with 30 steps."""
    scenes = StopSignApproach().training_scenes()
    hardened = DetectorAdversarialTraining().load(YOLOv3Tiny(), 0, FACTS)
    frames = (scenes.visible > 0.9).nonzero().squeeze(1)[::9]

    def seen(detector: Detector, patch: Tensor | None) -> float:
        with torch.no_grad():
            patches = None if patch is None else patch[None]
            predictions = detector(scenes.render(frames, patches, 0.5))
            return float(confidence(predictions, detector.index(STOP_SIGN), scenes.boxes[frames]).mean())

    left = {}
    for name, detector in (("undefended", published), ("hardened", hardened)):
        torch.manual_seed(0)
        oracle = PatchEnforcer(detector, PatchThreat(), "gradients", torch.Generator().manual_seed(0)).oracle
        attack = EOT(steps=30, batch=4, window=224, learning_rate=0.1)
        left[name] = seen(detector, attack.craft(oracle, scenes, lambda share, text: None))
    assert left["hardened"] > 0.8 > 0.5 > left["undefended"]
    assert seen(hardened, None) > seen(published, None) - 0.05


@pytest.mark.slow
def test_the_shipped_detector_knows_the_sign_from_faces_that_it_never_saw(published: YOLOv3TinyNetwork) -> None:
    world = StopSignApproach()
    (approach,) = world.approaches(world.axes.cell(lanes=3, density=1.0, weather="clear"), range(1))
    hardened = DetectorAdversarialTraining().load(YOLOv3Tiny(), 0, FACTS)
    with torch.no_grad():
        of_sign = look(hardened, approach.scenes, None, 0.5).confidence.mean()
        of_decoys, fooled = (look_at_decoys(one, approach.scenes).confidence for one in (hardened, published))
    assert of_sign > 0.8
    assert of_decoys.mean() < min(0.15, fooled.mean())
