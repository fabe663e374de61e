"""The meshes of the vehicles."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from cavbench.envs.camera.street.material import TAIL_LIGHT_LIT
from cavbench.envs.camera.street.vehicles import PAINTS, Model, vehicle


@pytest.mark.parametrize("model", get_args(Model))
def test_both_tail_lamps_shine_backwards(model: Model) -> None:
    """A lamp is an emitter, which shines to the side that its corners go around counter-clockwise."""
    (lamps,) = (mesh for mesh, material in vehicle(model, PAINTS[0], lights=True) if material is TAIL_LIGHT_LIT)
    a, b, c = (lamps.vertices[lamps.triangles[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    assert (normals[:, 1] < 0).all()
    assert np.allclose(normals[:, [0, 2]], 0)
    sides = np.sign((a + b + c)[:, 0])
    assert (sides == [-1, -1, 1, 1]).all()
