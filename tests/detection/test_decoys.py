"""Decoys: average precision as others compute it, and a score that cannot be raised by saying "stop" more often."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.metrics import average_precision_score

from cavbench.detection import Decoy, Detections, Predictions
from cavbench.detection.boxes import best_other
from cavbench.detection.discrimination import discrimination, if_visible, stops_by_family
from cavbench.detection.precision import average_precision, precision_of_approach
from cavbench.detection.sight import Sight, look, look_at_decoys
from tests.plugins.toy_camera import RedDetector, RedScenes, StopEverywhere

DETECTED = st.lists(st.tuples(st.sampled_from(np.linspace(0, 1, 6).tolist()), st.booleans()), max_size=30)
SIGN = [10.0, 10.0, 20.0, 20.0]


def boxes(*found: tuple[list[float], float]) -> Detections:
    places = torch.tensor([box for box, _ in found]).reshape(-1, 4)
    return Detections(places, torch.tensor([score for _, score in found]), torch.zeros(len(found), dtype=torch.int64))


def discriminated(detector: torch.nn.Module) -> dict[str, float]:
    scenes = RedScenes(torch.linspace(30, 8, 10))
    seen, decoys = look(detector, scenes, None, 0.5), look_at_decoys(detector, scenes)  # type: ignore[arg-type]
    return {name: float(values[0]) for name, values in discrimination([seen], [decoys], [scenes]).items()}


@settings(deadline=None)
@given(detected=DETECTED, missed=st.integers(0, 5))
def test_average_precision_is_that_of_scikit_learn(detected: list[tuple[float, bool]], missed: int) -> None:
    scores, true = (np.array(each) for each in zip(*detected, strict=True)) if detected else (np.zeros(0), np.zeros(0))
    hits = int(true.sum())
    found = average_precision(scores, true.astype(bool), hits + missed)
    if not hits + missed:
        assert np.isnan(found)
    elif not hits:
        assert found == 0
    else:
        # It knows no signs without a detection: they stretch the axis of recall.
        assert found == pytest.approx(average_precision_score(true, scores) * hits / (hits + missed))


def test_the_average_precision_of_an_approach_by_hand() -> None:
    real = [
        boxes((SIGN, 0.9), ([11.0, 10, 20, 20], 0.7), ([50.0, 50, 60, 60], 0.3)),
        boxes(([10.0, 10, 14, 20], 0.95)),
        boxes((SIGN, 0.99)),
    ]
    decoys = [boxes((SIGN, 0.8)), boxes(), boxes()]
    # In the third frame the sign is hidden, so nothing there counts. One of two signs is found, behind the box of the
    # second frame, whose IoU is .4: .5 x 1 / 2.
    found = precision_of_approach(real, decoys, torch.tensor([SIGN] * 3), torch.tensor([1.0, 0.9, 0.2]))
    assert found == pytest.approx(0.25)
    perfect = precision_of_approach([boxes((SIGN, 0.4))], [boxes((SIGN, 0.3))], torch.tensor([SIGN]), torch.ones(1))
    assert perfect == 1


def test_a_detector_that_knows_the_sign_scores_high_and_one_that_says_stop_everywhere_scores_0() -> None:
    honest, cheat = discriminated(RedDetector()), discriminated(StopEverywhere())
    assert honest["average_precision"] == 1
    assert honest["octagons"] == honest["false_stops"] == 0
    assert honest["stop_score"] > 0.5
    assert cheat["stop_score"] == 0
    assert cheat["average_precision"] < 0.5
    assert (cheat["octagons"], cheat["false_stops"]) == (1, 2)


@settings(deadline=None)
@given(
    real=st.lists(st.floats(0, 1), min_size=10, max_size=10),
    decoys=st.lists(st.floats(0, 1), min_size=10, max_size=10),
    more=st.floats(0, 1),
)
def test_more_confidence_in_everything_does_not_raise_the_score(
    real: list[float], decoys: list[float], more: float
) -> None:
    scenes = RedScenes(torch.linspace(30, 8, 10))

    def score(added: float) -> float:
        # Closer to 1 by the same share, whatever is on the post.
        sights = [
            Sight(np.array([c + added * (1 - c) for c in said], np.float32), [boxes()] * 10, [""] * 10)
            for said in (real, decoys)
        ]
        return float(discrimination([sights[0]], [sights[1]], [scenes])["stop_score"][0])

    assert score(more) <= score(0.0) + 1e-6


def test_a_world_without_decoys_is_scored_by_the_confidence_alone() -> None:
    scenes = RedScenes(torch.linspace(30, 8, 10))
    scenes.decoys = ()
    seen = look(RedDetector(), scenes, None, 0.5)
    assert look_at_decoys(RedDetector(), scenes) is None
    found = discrimination([seen], [None], [scenes])
    assert found["stop_score"][0] == pytest.approx(seen.confidence.mean())
    assert np.isnan(found["average_precision"][0])


def test_what_is_seen_of_a_visible_sign_by_hand() -> None:
    scenes = RedScenes(torch.linspace(30, 8, 5))
    scenes.visible = torch.tensor([0.2, 0.5, 1.0, 1.0, 1.0])
    sight = Sight(np.array([0.0, 0.9, 0.1, 0.2, 0.1], np.float32), [boxes()] * 5, ["bus", "", "clock", "kite", "clock"])
    found = if_visible([sight], [scenes])
    assert found["confidence_visible"][0] == pytest.approx(1.3 / 4)
    assert found["misread"][0] == 0.75
    assert found["seen_instead"][0] == "clock"
    scenes.visible = torch.zeros(5)
    hidden = if_visible([sight], [scenes])
    assert np.isnan(hidden["confidence_visible"][0])
    assert hidden["seen_instead"][0] == ""


def test_the_best_other_class_is_the_one_at_the_place_of_the_sign() -> None:
    places = torch.tensor([[SIGN, [50.0, 50, 60, 60]], [[50.0, 50, 60, 60]] * 2])
    classes = torch.tensor([[[0.2, 0.9, 0.6], [1.0, 0, 0]], [[0.0, 0, 1], [0, 0, 1]]])
    predictions = Predictions(places, torch.full((2, 2), 0.5), classes)
    found = best_other(predictions, 1, torch.tensor([SIGN, SIGN]))
    assert found == [(pytest.approx(0.3), 2), (0.0, 1)]


def test_false_stops_by_family_by_hand() -> None:
    scenes = RedScenes(torch.linspace(30, 8, 6))
    kinds = ("words", "words", "colours", "stops", "stops", "stops")
    scenes.faces = tuple(Decoy(str(n), octagonal=True, family=kind) for n, kind in enumerate(kinds))
    scenes.visible = torch.tensor([1.0, 1.0, 1.0, 1.0, 0.9, 0.1])
    stop = boxes((SIGN, 0.9))
    sight = Sight(
        np.array([0.9, 0, 0.1, 0.9, 0.2, 0], np.float32), [stop, boxes(), boxes((SIGN, 0.1)), *[stop] * 3], [""] * 6
    )
    found = {name: float(values[0]) for name, values in stops_by_family([sight], [scenes]).items()}
    assert found["false_stops_words"] == 0.5
    assert found["false_stops_colours"] == 0
    assert np.isnan(found["false_stops_signs"])
    assert found["false_stops_faces"] == pytest.approx(1 / 3)
    # The third foreign stop sign is hidden, the second is not detected.
    assert found["foreign_stops"] == 0.5
    assert all(np.isnan(values[0]) for values in stops_by_family([None], [RedScenes(torch.ones(1))]).values())
