"""JPEG compression before a detector."""

from __future__ import annotations

import pytest

from cavbench.defenses.detection.jpeg import JPEG
from tests.detection.test_filter import guarded, pictures


def test_a_lower_quality_loses_more() -> None:
    shown = pictures()
    lost = [float((guarded(JPEG(quality=q)).defense.filter(shown) - shown).abs().mean()) for q in (10, 40, 95)]
    assert lost[0] > lost[1] > lost[2] > 0


def test_a_parameter_out_of_range_is_named() -> None:
    with pytest.raises(ValueError, match="must be"):
        JPEG(quality=0)
