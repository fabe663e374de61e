"""Median smoothing before a detector."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from cavbench.defenses.detection.median import MedianSmoothing
from tests.detection.test_filter import guarded, pictures


def test_the_median_equals_opencvs_of_a_reflected_picture() -> None:
    shown = (pictures(1) * 255).round() / 255
    transformed = guarded(MedianSmoothing(size=5)).defense.filter(shown)[0].permute(1, 2, 0).numpy()
    given = (shown[0].permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
    wanted = cv2.medianBlur(given, 5) / 255
    assert np.allclose(transformed[2:-2, 2:-2], wanted[2:-2, 2:-2], atol=1e-6)
    # At the border OpenCV repeats the last pixel. kornia 0.9 reflects; another version may do otherwise.
    assert not np.allclose(transformed, wanted, atol=1e-6)
    reflected = cv2.medianBlur(cv2.copyMakeBorder(given, 2, 2, 2, 2, cv2.BORDER_REFLECT_101), 5)[2:-2, 2:-2] / 255
    assert np.allclose(transformed, reflected, atol=1e-6)


def test_a_parameter_out_of_range_is_named() -> None:
    with pytest.raises(ValueError, match="must be"):
        MedianSmoothing(size=4)
