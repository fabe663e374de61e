"""Labels of the frames of the camera world."""

from __future__ import annotations

import numpy as np
import torch

from cavbench.detection import STOP_SIGN
from cavbench.envs.camera import sign
from cavbench.envs.camera.objects import NAMES, objects
from cavbench.envs.camera.poses import scored, training
from cavbench.envs.camera.street.layout import sign_x
from tests.envs.camera.scenes import scenes


def test_every_training_view_has_its_sign_and_other_objects() -> None:
    named: set[str] = set()
    for pose in training():
        found = dict(reversed(objects(pose)))
        limit = np.array([pose.camera.width, pose.camera.height] * 2)
        assert np.allclose(found[STOP_SIGN], sign.box(sign_x(pose.lanes), pose.camera).clip(0, limit), atol=0.01)
        for box in found.values():
            assert (box[2:] - box[:2]).min() >= 6
            assert (box >= 0).all()
            assert (box <= limit).all()
        named |= set(found)
    assert named == set(NAMES)


def test_a_hidden_sign_has_no_label() -> None:
    """Hidden by traffic, or outside the image because the ego is near."""
    hidden = [pose for pose in scored() if pose.lighting == "sun" and STOP_SIGN not in dict(objects(pose))]
    assert {pose.distance > 12 for pose in hidden} == {True, False}
    assert len(hidden) < 30


def test_scenes_have_the_labels_of_their_frames() -> None:
    street = scenes("fog")
    found = street.objects(9)
    assert found.names[0] in NAMES
    assert found.boxes.shape == (len(found.names), 4)
    assert torch.allclose(found.boxes[found.names.index(STOP_SIGN)], street.boxes[9], atol=0.01)
