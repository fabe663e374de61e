"""What tests of several folders need."""

from __future__ import annotations

import pytest

from cavbench.detection.victims.yolov3_tiny import YOLOv3Tiny, YOLOv3TinyNetwork
from cavbench.envs.camera.world import StopSignApproach
from cavbench.errors import UserError
from cavbench.run.process import settle
from tests.command import bench, plugins, toy_folder

__all__ = ["bench", "plugins", "toy_folder"]
FACTS = StopSignApproach().facts

# Tests run in as many processes as there are cores: threads that wait for each other would only be in the way.
settle()


@pytest.fixture(scope="session")
def published() -> YOLOv3TinyNetwork:
    """YOLOv3-tiny with its published weights, which are fetched if need be; without a network the test is skipped."""
    try:
        return YOLOv3Tiny().load(0, FACTS)
    except UserError as error:
        if "cannot be downloaded" not in str(error):
            raise
        pytest.skip(str(error))
