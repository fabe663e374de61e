"""A victim of the tests of trained defences."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from cavbench.detection import STOP_SIGN
from cavbench.detection.victims import yolov5_file
from cavbench.detection.victims.yolov5 import YOLOv5, YOLOv5Network


@pytest.fixture
def victim(tmp_path: Path) -> YOLOv5:
    """A small untrained detector."""
    torch.manual_seed(0)
    path = tmp_path / "own.safetensors"
    yolov5_file.save(YOLOv5Network("n", (STOP_SIGN, "car")), path)
    return YOLOv5(path=str(path))
