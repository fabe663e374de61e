"""The suites of attacks on detectors; the lists are in the TOML files of this folder."""

from __future__ import annotations

from pathlib import Path

from cavbench.core.suites import Suite

STANDARD_DETECTION_3 = Suite.read(Path(__file__).with_name("standard-detection-3.toml"))
