"""The path tracer: a composite is equal to a direct render."""

from __future__ import annotations

import numpy as np
import pytest
import torch

pytest.importorskip("mitsuba", reason="the renderer is not installed: pip install 'cavbench[render]'")
pytest.importorskip("pyoidn", reason="the denoiser is not installed: pip install 'cavbench[render]'")

from cavbench.envs.camera import sign
from cavbench.envs.camera.camera import Camera
from cavbench.envs.camera.plate import detail, filtered, texture_mean
from cavbench.envs.camera.street import layout, render
from cavbench.envs.camera.street.light import light

CAMERA = Camera(y=-9.0, width=312, height=96, focal=180.0)
LANES = 3


@pytest.fixture(scope="module", autouse=True)
def scalar() -> None:
    """The Mitsuba variant that every machine has."""
    render.variant.cache_clear()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MITSUBA_VARIANT", "scalar_rgb")
        render.variant()


@pytest.mark.slow
@pytest.mark.parametrize("lighting", ["sun", "overcast"])
def test_a_composite_is_equal_to_a_direct_render(lighting: str) -> None:
    """With a black and white chessboard on the sign, the most demanding texture."""
    place = layout.LOCATIONS["sun-behind-ego"]
    parts = layout.street(place, lanes=LANES, density=1.0, distance=9.0, lights=False)
    lit = light("sun" if lighting == "sun" else "overcast", place.sun_azimuth_deg)
    x = layout.sign_x(LANES)
    traced = render.trace(render.load(parts, lit, CAMERA, x), lit, CAMERA, x, seed=0)
    board = ((torch.arange(8)[:, None] + torch.arange(8)) % 2).float().expand(1, 3, 8, 8)
    faces = sign.painted(board, 0.5)
    x0, y0, x1, y1 = traced.crop
    face = filtered(faces, detail(traced.crop))[0]
    mean = texture_mean(traced.crop, face, sign.pixel_to_face(x, CAMERA)).permute(1, 2, 0).numpy()
    composite = traced.black[y0:y1, x0:x1] + traced.gain * mean

    mi = render._mitsuba()
    scene = render._scene(parts, lit, CAMERA, x)
    texture = render._bitmap(faces[0].permute(1, 2, 0).numpy())
    scene["sign"] = render._shape("sign", render._face(x), {"type": "diffuse", "reflectance": texture})
    sensor = mi.load_dict(render._sensor(CAMERA, traced.crop))
    path = mi.load_dict({"type": "path", "max_depth": render.BOUNCES})
    direct = np.array(mi.render(mi.load_dict(scene), sensor=sensor, integrator=path, spp=256, seed=1))[..., :3]

    error = np.abs(composite - direct)[traced.coverage > 0.99]
    assert len(error) > 400
    assert error.mean() < 0.03 * direct.max()


@pytest.mark.slow
def test_a_scene_that_was_traced_gives_the_same_picture_again() -> None:
    place = layout.LOCATIONS["sun-beside"]
    small = Camera(y=-20.0, width=96, height=32, focal=55.0)
    parts = layout.street(place, lanes=LANES, density=1.0, distance=20.0, lights=True)
    lit, x = light("night", place.sun_azimuth_deg), layout.sign_x(LANES)
    world = render.load(parts, lit, small, x)
    first, again = (render.trace(world, lit, small, x, seed=3) for _ in range(2))
    assert np.array_equal(first.black, again.black)
    assert np.array_equal(first.gain, again.gain)
    assert first.gain.max() > 0
    assert (first.printed > 0).all()
    assert (first.printed < 0.8).all()
    assert first.depth.shape == (render.DEPTH_GRID**2, 32, 96)
    # The sky is above, and the road is near below.
    assert np.isinf(first.depth[:, 0]).mean() > 0.1
    assert first.depth[:, -1].max() < 15
