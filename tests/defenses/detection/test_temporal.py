"""Temporal fusion: how evidence adds up and fades, where a sign is expected, the gradient, and the closed loop."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from cavbench.attacks.detection.eot import EOT
from cavbench.attacks.detection.views import reported
from cavbench.core.pair import choose
from cavbench.defenses.detection.temporal import HIGHEST, MATCH_IOU, SINGLE, Fused, TemporalFusion
from cavbench.detection import Detector, PatchThreat, Predictions
from cavbench.detection.access import PatchEnforcer
from cavbench.detection.approach import score
from cavbench.detection.boxes import overlap
from cavbench.detection.closed_loop import Drive, drive
from cavbench.detection.sight import look
from cavbench.detection.stopping import THRESHOLD
from cavbench.detection.victims.yolov3_tiny import YOLOv3Tiny
from cavbench.envs.camera import sign
from cavbench.envs.camera.bank import BankScenes
from cavbench.envs.camera.crossing import StopSignCrossing
from cavbench.envs.camera.environment import ApproachEnv
from cavbench.envs.camera.poses import approach
from cavbench.envs.camera.street.layout import sign_x
from cavbench.envs.camera.world import StopSignApproach
from tests.plugins.toy_camera import RED_AXES, RedDetector, RedScenes, RedStreet, RedVictim

SCORES = st.lists(st.floats(0, 1), min_size=1, max_size=12)
FAR = TemporalFusion(focal=1e5, vanishing_x=16.0, vanishing_y=16.0)
"""For the toy street, whose sign stays where it is in the image."""


def fused(recipe: TemporalFusion = FAR) -> Fused:
    found = recipe.load(RedVictim(), 0, RedStreet().facts)
    assert isinstance(found, Fused)
    return found


def told(scores: list[float], recipe: TemporalFusion = FAR) -> Tensor:
    """What is reported of a sign with these scores."""
    return fused(recipe).aggregate(torch.tensor(scores))


@given(score=st.floats(0, 1), before=st.integers(0, 5), after=st.integers(0, 5))
def test_a_detection_in_a_single_frame_does_not_count(score: float, before: int, after: int) -> None:
    assert told([0.0] * before + [score] + [0.0] * after).max() <= SINGLE + 1e-5 < THRESHOLD


def test_a_sign_seen_far_away_is_remembered_and_the_evidence_fades() -> None:
    seen = told([0.95, 0.95, 0.95] + [0.0] * 20)
    assert seen[2] == pytest.approx(HIGHEST, abs=1e-3)
    assert (seen[3:].diff() <= 0).all()
    assert seen[8] > THRESHOLD
    assert seen[-1] < SINGLE
    assert told([0.95, 0.95, 0.95] + [0.0] * 20, TemporalFusion(miss=0.0))[-1] == pytest.approx(HIGHEST, abs=1e-3)


def test_the_order_of_the_frames_matters() -> None:
    assert told([0.9, 0.9, 0.0, 0.0])[-1] < told([0.0, 0.0, 0.9, 0.9])[-1]
    assert told([0.9, 0.9, 0.0, 0.0])[1] > told([0.0, 0.0, 0.9, 0.9])[1]


@given(scores=SCORES, place=st.integers(0, 11), more=st.floats(0, 1))
def test_a_higher_score_lowers_no_report(scores: list[float], place: int, more: float) -> None:
    higher = list(scores)
    higher[place % len(scores)] = max(more, scores[place % len(scores)])
    assert (told(higher) >= told(scores) - 1e-6).all()


def test_weak_evidence_adds_up() -> None:
    """No frame is above the threshold of detection, but together they are."""
    weak = [0.24] * 12
    assert max(weak) < THRESHOLD < float(told(weak)[-1])


@given(scores=SCORES)
def test_each_frame_has_a_gradient_where_scores_are_clipped_too(scores: list[float]) -> None:
    asked = torch.tensor(scores).clamp(1e-4, 1 - 1e-4).requires_grad_(True)
    (gradient,) = torch.autograd.grad(fused().aggregate(asked)[-1], asked)
    assert (gradient > 0).all()


@pytest.mark.parametrize("lanes", [3, 4, 5])
def test_a_sign_is_expected_where_it_will_be(lanes: int) -> None:
    poses, at = approach("sun-behind-ego", lanes, 1.0, "sun"), sign_x(lanes)
    boxes = torch.from_numpy(np.stack([sign.box(at, pose.camera) for pose in poses])).float()
    moved = [before.distance - after.distance for before, after in pairwise(poses)]
    detector = fused(TemporalFusion())
    expected = torch.cat([detector.moved(box[None], step) for box, step in zip(boxes, moved, strict=False)])
    assert overlap(expected, boxes[1:]).min() > 0.85
    assert overlap(boxes[:-1], boxes[1:]).min() < MATCH_IOU, "without the motion it would be lost"


def seen_at(places: list[tuple[float, float]], score: float = 0.9) -> Predictions:
    """A stop sign of 20 pixels at a place in each frame."""
    corners = torch.tensor(places).float()[:, None]
    classes = torch.tensor([0.1, 1.0]).expand(len(places), 1, 2)
    return Predictions(torch.cat([corners, corners + 20], -1), torch.full((len(places), 1), score), classes)


def test_false_detections_at_different_places_do_not_add_up() -> None:
    detector, moved = fused(), torch.zeros(4)
    scattered, _ = detector.advance(seen_at([(0, 0), (40, 0), (80, 0), (120, 0)]), moved, detector.initial())
    in_place, _ = detector.advance(seen_at([(0, 0), (2, 1), (4, 0), (2, 2)]), moved, detector.initial())
    assert scattered.scores_of(1).max() < THRESHOLD
    assert in_place.scores_of(1).amax(-1)[-1] == pytest.approx(HIGHEST, abs=1e-3)
    assert torch.equal(in_place.scores_of(0)[:, :1], seen_at([(0, 0)] * 4).scores_of(0)), "other classes stay"


@settings(deadline=None, max_examples=10)
@given(red=st.lists(st.floats(0, 1), min_size=2, max_size=40))
def test_attacks_optimise_what_is_scored(red: list[float]) -> None:
    """On an approach `advance` reports what `aggregate` says, and nothing where the evidence is against a sign."""
    scenes = RedScenes(torch.linspace(30, 8, len(red)))
    scenes.red = torch.tensor(red)
    detector = fused()
    with torch.no_grad():
        seen = look(detector, scenes, None, 0.5)
        wanted = detector.aggregate(torch.from_numpy(seen.by_frame))
    tracked = torch.from_numpy(seen.confidence) > 0
    assert torch.allclose(torch.from_numpy(seen.confidence)[tracked], wanted[tracked], atol=1e-5)
    assert wanted[~tracked].max() <= detector.aggregate(torch.zeros(1)) + 1e-6 if (~tracked).any() else True


class Decoying(Fused):
    """Lets attacks optimise other scores than are reported."""

    def aggregate(self, scores: Tensor) -> Tensor:
        return 1 - super().aggregate(scores)


class Silent(RedDetector):
    """Without a memory, too, attacks can be given something else."""

    def aggregate(self, scores: Tensor) -> Tensor:
        return scores * 0.1


def inconsistent(detector: Detector) -> float:
    scored = score(detector, RedStreet().approaches(RED_AXES.cell(lanes=3, density=1.0), range(3)), None, share=0.5)
    return float(scored["inconsistent"].max())


def test_a_detector_that_reports_otherwise_than_attacks_optimise_is_flagged() -> None:
    assert inconsistent(Decoying(RedDetector(), FAR)) == inconsistent(Silent()) == 1.0
    assert inconsistent(fused()) == inconsistent(RedDetector()) == 0.0


def test_eot_reaches_through_the_frames_of_an_approach() -> None:
    detector, scenes = fused(), RedScenes(torch.linspace(30, 8, 6))
    attack = EOT(texels=8, steps=30, batch=4, window=32, loss="log_odds")
    enforcer = PatchEnforcer(detector, PatchThreat(budget=0.9), attack.access, torch.Generator().manual_seed(0))
    patch = attack.craft(enforcer.oracle, scenes, lambda share, text: None)
    assert (enforcer.spent, enforcer.backwards, enforcer.zeros) == (120, 120, 0)
    with torch.no_grad():
        clean, patched = (look(detector, scenes, one, 0.9).confidence.mean() for one in (None, patch))
    assert patched < THRESHOLD < clean


def test_views_are_put_in_the_order_of_an_approach() -> None:
    scores, distance = torch.tensor([0.1, 0.9, 0.2, 0.8]), torch.tensor([8.0, 30.0, 10.0, 20.0])
    oracle, plain = (
        PatchEnforcer(one, PatchThreat(), "gradients", torch.Generator()).oracle for one in (fused(), RedDetector())
    )
    order = torch.tensor([1, 3, 2, 0])
    assert torch.equal(reported(oracle, scores, distance)[order], fused().aggregate(scores[order]))
    assert torch.equal(reported(plain, scores, distance), scores), "without a memory nothing changes"


def driven(seen: list[bool], detector: Detector) -> Drive:
    """The drive of a car on a road that shows the sign in these frames only."""
    scenes = RedScenes(torch.arange(30.0, 7.9, -0.5))
    scenes.red = torch.tensor((seen + [False] * len(scenes))[: len(scenes)]).float()
    return drive(detector, ApproachEnv([scenes]))


def test_in_closed_loop_a_flickering_sign_stops_the_car_and_a_single_frame_does_not() -> None:
    """Two of five frames are never enough for the driver, but they are evidence."""
    sharp, flickers = RedDetector(bias=-4.0), [True, True, False, False, False] * 3
    assert not driven(flickers, sharp).stopped
    assert driven(flickers, FAR.around(sharp)).stopped
    assert not driven([True], FAR.around(sharp)).stopped


def test_a_chain_keeps_the_memory() -> None:
    chain = choose("defense", "median+temporal").component.load(RedVictim(), 0, RedStreet().facts)
    scores = torch.tensor([0.9, 0.9])
    assert torch.equal(chain.aggregate(scores), TemporalFusion().around(RedDetector()).aggregate(scores))


def test_impossible_options_are_refused() -> None:
    for bad in ({"hit": 0.0}, {"miss": -0.1}, {"neutral": 0.0}, {"neutral": 1.0}, {"focal": 0.0}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            TemporalFusion(**bad)


def test_yolov3_tiny_keeps_a_sign_that_a_noise_patch_flickers_away() -> None:
    """A real detector on real frames: the fused score is the filter's of the frame scores at the sign's moving place."""
    (whole,) = StopSignCrossing().approaches(StopSignCrossing.axes.cell(weather="clear", speed=10.0), range(1))
    assert isinstance(whole.scenes, BankScenes)
    frames = list(zip(whole.scenes.poses, whole.scenes.frames, strict=True))[50:74:4]
    scenes = BankScenes(frames, ["clear"] * len(frames))
    detector = TemporalFusion().load(YOLOv3Tiny(), 0, StopSignApproach().facts)
    with torch.no_grad():
        seen = look(detector, scenes, torch.rand(3, 64, 64, generator=torch.Generator().manual_seed(0)), 0.5)
        wanted = detector.aggregate(torch.from_numpy(seen.by_frame)).numpy()
    tracked = seen.confidence > 0
    assert tracked.sum() >= 3
    assert np.allclose(seen.confidence[tracked], wanted[tracked], atol=0.05)
    assert not np.allclose(seen.confidence, seen.by_frame, atol=0.05)
