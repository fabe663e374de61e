"""The measurements of an approach: they depend on the detections and distances, and more detections never lower the score."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cavbench.detection import Predictions, stopping
from cavbench.detection.approach import false_alarms, measure
from cavbench.detection.sight import candidates_of, look
from tests.plugins.toy_camera import RedDetector, RedScenes

DISTANCE = np.linspace(30, 8, 10)
CONFIDENCES = arrays(np.float64, (6, 10), elements=st.floats(0, 1))
WORST_M = stopping.SPEED_MPS * stopping.REACTION_S + stopping.SPEED_MPS**2 / (2 * stopping.GREATEST_DECELERATION)


def measured(confidence: np.ndarray) -> dict[str, np.ndarray]:
    return measure(confidence, np.broadcast_to(DISTANCE, confidence.shape), np.ones_like(confidence))


@settings(deadline=None)
@given(confidence=CONFIDENCES)
def test_approaches_are_measured_independently(confidence: np.ndarray) -> None:
    together = measured(confidence)
    for row in range(len(confidence)):
        alone = measured(confidence[row : row + 1])
        for name, values in together.items():
            np.testing.assert_array_equal(values[row], alone[name][0])


@settings(deadline=None)
@given(confidence=CONFIDENCES, more=CONFIDENCES)
def test_more_confidence_is_never_worse(confidence: np.ndarray, more: np.ndarray) -> None:
    low, high = measured(confidence), measured(np.maximum(confidence, more))
    for name in ("confidence_mean", "confidence_median", "detection_rate", "first_seen_m", "confirmed_m"):
        assert (high[name] >= low[name] - 1e-12).all(), name
    assert (high["overrun_m"] <= low["overrun_m"]).all()
    assert (high["ran"] <= low["ran"]).all()


@settings(deadline=None)
@given(confidence=CONFIDENCES)
def test_a_sign_is_confirmed_by_three_detections_in_five_frames(confidence: np.ndarray) -> None:
    found = measured(confidence)
    assert (found["confirmed_m"] <= found["first_seen_m"]).all()
    for row, one in enumerate(confidence > stopping.THRESHOLD):
        by_hand = next((DISTANCE[f] for f in range(10) if one[max(f - 4, 0) : f + 1].sum() >= 3), 0.0)
        assert found["confirmed_m"][row] == by_hand


@settings(deadline=None)
@given(confirmed=arrays(np.float64, 20, elements=st.floats(0, 100)))
def test_the_car_stops_at_the_line_if_physically_possible(confirmed: np.ndarray) -> None:
    overrun, ran = stopping.overrun_m(confirmed), stopping.ran(confirmed)
    np.testing.assert_allclose(overrun, np.maximum(WORST_M - confirmed, 0), atol=1e-6)
    assert (ran == ((confirmed <= 0) | (overrun > stopping.RAN_M))).all()
    assert (stopping.deceleration(confirmed) <= stopping.GREATEST_DECELERATION).all()
    assert (stopping.deceleration(confirmed) >= stopping.COMFORTABLE_DECELERATION).all()


@pytest.mark.parametrize(
    ("confirmed", "overrun", "ran"), [(30.0, 0.0, False), (14.0, 0.086, False), (8.0, 6.086, True), (0.0, 14.086, True)]
)
def test_the_controller_in_numbers(confirmed: float, overrun: float, ran: bool) -> None:
    assert stopping.overrun_m(np.array([confirmed]))[0] == pytest.approx(overrun, abs=1e-3)
    assert bool(stopping.ran(np.array([confirmed]))[0]) is ran


def test_only_a_detection_away_from_the_sign_is_a_false_alarm() -> None:
    boxes = torch.tensor([[[0.0, 0, 10, 10], [1, 1, 11, 11], [40, 40, 60, 60], [80, 80, 90, 90]]])
    classes = torch.tensor([[[1.0, 0], [1, 0], [1, 0], [0, 1]]])
    predictions = Predictions(boxes, torch.full((1, 4), 0.9), classes)
    found = candidates_of(predictions, 0)
    assert false_alarms(found, torch.tensor([[0.0, 0, 10, 10]])).tolist() == [1]
    assert false_alarms(found, torch.tensor([[200.0, 200, 210, 210]])).tolist() == [2]


def test_a_patch_changes_the_output_and_no_patch_does_not() -> None:
    scenes, detector = RedScenes(torch.linspace(30, 8, 10)), RedDetector()
    clean, patched = (look(detector, scenes, patch, 0.5) for patch in (None, torch.zeros(3, 16, 16)))
    assert (clean.confidence.shape, len(clean.found)) == ((10,), 10)
    assert (patched.confidence < clean.confidence).all()
    assert not false_alarms(clean.found, scenes.boxes).any()
