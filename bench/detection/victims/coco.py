"""The classes of the COCO detection data set (Lin et al. 2014), in the label order of detectors trained on it."""

from __future__ import annotations

from pathlib import Path

NAMES = tuple(Path(__file__).with_name("coco.names").read_text().splitlines())
