"""Path-traces a pose with Mitsuba 3 (Jakob et al. 2022): the light at the camera, and the part that the sign adds.

The light of a matt sign is linear in its texture, L = B + G * texture: B is the image with a black sign, G the light that a white
sign adds. So a pose is traced once, and any texture is put on the sign afterwards.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavbench.envs.camera import sign
from cavbench.envs.camera.camera import Array, Camera
from cavbench.envs.camera.street import light as lights
from cavbench.envs.camera.street.layout import lamp_heads
from cavbench.envs.camera.street.light import Light
from cavbench.envs.camera.street.material import Material
from cavbench.envs.camera.street.mesh import Mesh
from cavbench.envs.camera.street.textures import noise
from cavbench.envs.camera.street.vehicles import Part
from cavbench.errors import notice

SAMPLES, GUIDE_SAMPLES, SIGN_SAMPLES = 8, 4, 64
"""Paths a pixel for the image, for the guides of the denoiser, and for the crop of the sign."""
DEPTH_GRID = 4
"""Rays along the side of a pixel for the depth. With their mean, fog would draw dark specks at the edges of poles."""
BOUNCES = 5
MARGIN = 3
"""Margin of the crop around the sign in pixels."""
RETROREFLECTION = ((0.2, 250.0), (0.5, 95.0), (1.0, 18.0), (2.0, 5.5), (4.0, 1.6), (8.0, 0.6))
"""Retroreflection in cd/lx/m2 by observation angle in degrees, for white ASTM D4956 type III; extrapolated beyond 0.5 degrees."""


@dataclass(frozen=True)
class Traced:
    """A path-traced pose, in linear light.

    Args:
        black: light with a black sign, [H, W, 3].
        crop: x0, y0, x1, y1 around the sign in pixels, inside the image; empty if the sign is outside.
        gain: light that a white sign adds on the crop, [h, w, 3].
        coverage: share of each pixel of the crop that shows the sign, [h, w].
        printed: share of the gain that a white print on the sign has, [3]: the rest is retroreflected by the sheeting under it.
        depth: depth along the line of sight of each ray of a pixel in m, [rays, H, W]; inf is the sky.
    """

    black: NDArray[np.float32]
    crop: tuple[int, int, int, int]
    gain: NDArray[np.float32]
    coverage: NDArray[np.float32]
    printed: NDArray[np.float32]
    depth: NDArray[np.float32]


PROBE = """
import sys
import mitsuba as mi
mi.set_variant(sys.argv[1])
sky = {"type": "envmap", "bitmap": mi.Bitmap(mi.TensorXf([0.5] * 96, (4, 8, 3)))}
camera = {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}}
scene = mi.load_dict({"type": "scene", "sky": sky, "ball": {"type": "sphere"}, "camera": camera})
mi.Bitmap(mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=1))
"""
"""Renders a picture with what the street needs: a path tracer and an environment map."""


@cache
def variant() -> str:
    """The Mitsuba variant: MITSUBA_VARIANT, else `llvm_ad_rgb` if LLVM can be loaded, else `scalar_rgb`.

    One variant gives equal results in any process with any number of threads. Two variants differ in noise.
    """
    if wanted := os.environ.get("MITSUBA_VARIANT"):
        return wanted
    if works("llvm_ad_rgb"):
        return "llvm_ad_rgb"
    notice("the renderer finds no LLVM that works: it uses the variant scalar_rgb, which is slower")
    return "scalar_rgb"


@cache
def works(name: str) -> bool:
    """Whether a variant renders a small picture. A process of its own tries: some LLVM versions abort it."""
    return subprocess.run([sys.executable, "-c", PROBE, name], capture_output=True, check=False).returncode == 0


def load(parts: list[Part], light: Light, camera: Camera, sign_x: float) -> Any:
    """Load a scene with a black sign; it depends on the camera only if the headlights are on.

    Args:
        parts: everything except the face of the sign.
        light: light of the weather.
        camera: camera of the view.
        sign_x: x of the sign in m.
    """
    scene = _scene(parts, light, camera, sign_x)
    scene["sign"] = _shape("sign", _face(sign_x), {"type": "diffuse", "reflectance": _rgb((0, 0, 0))})
    return _mitsuba().load_dict(scene)


def trace(world: Any, light: Light, camera: Camera, sign_x: float, seed: int) -> Traced:
    """Trace a pose.

    Args:
        world: the scene that `load` returns; the same one can be traced from several places.
        light: light of the weather.
        camera: camera of the view.
        sign_x: x of the sign in m.
        seed: seed of the sampler.
    """
    mi = _mitsuba()
    path = mi.load_dict({"type": "path", "max_depth": BOUNCES})
    guides = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"})
    crop = _crop(camera, sign_x)

    def seen(integrator: Any, samples: int, window: tuple[int, int, int, int] | None = None) -> NDArray[np.float32]:
        sensor = mi.load_dict(_sensor(camera, window))
        return np.array(mi.render(world, sensor=sensor, integrator=integrator, spp=samples, seed=seed), np.float32)

    picture, guide = seen(path, SAMPLES)[..., :3], seen(guides, GUIDE_SAMPLES)
    black = _denoised(picture, guide[..., :3], guide[..., 3:])
    printed = np.ones(3, np.float32)
    gain = np.zeros((crop[3] - crop[1], crop[2] - crop[0], 3), np.float32)
    if gain.size:
        painted = mi.traverse(world)

        def with_sign(reflectance: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
            painted["sign.bsdf.reflectance.value"] = reflectance
            painted.update()
            return seen(path, SIGN_SAMPLES, crop)[..., :3], seen(guides, SIGN_SAMPLES, crop)[..., 0]

        (dark, no_albedo), (bright, albedo) = with_sign(0.0), with_sign(1.0)
        painted["sign.bsdf.reflectance.value"] = 0.0
        painted.update()
        coverage = np.clip(albedo - no_albedo, 0, 1)
        gain = np.where(coverage[..., None] > 0, np.clip(bright - dark, 0, None), 0).astype(np.float32)
        if light.headlights:
            matt = gain.sum((0, 1))
            gain += coverage[..., None] * _retroreflected(camera, sign_x)
            printed = matt / np.maximum(gain.sum((0, 1)), 1e-6)
    else:
        coverage = gain[..., 0]
    return Traced(black, crop, gain, coverage, printed, _depth(world, camera, seed))


def _depth(world: Any, camera: Camera, seed: int) -> NDArray[np.float32]:
    """Depth of each ray in m, [DEPTH_GRID ** 2, H, W]; inf is the sky."""
    mi = _mitsuba()
    sensor = mi.load_dict(_sensor(camera, None, DEPTH_GRID))
    integrator = mi.load_dict({"type": "aov", "aovs": "depth:depth"})
    seen = np.array(mi.render(world, sensor=sensor, integrator=integrator, spp=1, seed=seed), np.float32)
    rays = seen.reshape(camera.height, DEPTH_GRID, camera.width, DEPTH_GRID).transpose(1, 3, 0, 2)
    depth = rays.reshape(DEPTH_GRID**2, camera.height, camera.width)
    return np.where(depth > 0, depth, np.inf).astype(np.float32)


def _crop(camera: Camera, sign_x: float) -> tuple[int, int, int, int]:
    """The box of the sign with a margin, clipped to the image."""
    x0, y0, x1, y1 = sign.box(sign_x, camera)
    left, top = max(0, int(x0) - MARGIN), max(0, int(y0) - MARGIN)
    right, bottom = min(camera.width, int(x1) + MARGIN + 1), min(camera.height, int(y1) + MARGIN + 1)
    return left, top, max(left, right), max(top, bottom)


def _retroreflected(camera: Camera, sign_x: float) -> NDArray[np.float32]:
    """Radiance [3] of the headlights that white sheeting retroreflects."""
    middle = np.array([sign_x, 0.0, sign.HEIGHT_M])
    beam = lights.low_beam()
    total = 0.0
    for x in lights.HEADLIGHTS_X:
        lamp = _lamp(camera, x)
        ray, line = middle - lamp, middle - camera.position
        half = np.tan(np.deg2rad(lights.BEAM_FIELD_DEG / 2))
        column = int((ray[0] / ray[1] / half + 1) / 2 * beam.shape[1])
        row = int((1 - ray[2] / ray[1] / half * beam.shape[1] / beam.shape[0]) / 2 * beam.shape[0])
        if not (0 <= row < beam.shape[0] and 0 <= column < beam.shape[1]):
            continue  # outside the beam
        lux = lights.BEAM_PEAK_CD * beam[row, column] * ray[1] / np.linalg.norm(ray) ** 3
        cosine = ray @ line / np.linalg.norm(ray) / np.linalg.norm(line)
        angle = np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))
        angles, coefficients = zip(*RETROREFLECTION, strict=True)
        total += lux * np.exp(np.interp(np.log(angle), np.log(angles), np.log(coefficients)))
    return (total * np.array([1.0, 0.97, 0.9])).astype(np.float32)


def _lamp(camera: Camera, x: float) -> Array:
    """Position [3] of the headlight at `x` from the middle of the car."""
    return camera.position + np.array([x, lights.HEADLIGHT_AHEAD_M, lights.HEADLIGHT_HEIGHT_M - camera.z])


def _denoised(
    picture: NDArray[np.float32], albedo: NDArray[np.float32], normal: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Denoise with Intel's Open Image Denoise, guided by albedo and normals."""
    import pyoidn

    guides = {"albedo": np.ascontiguousarray(np.clip(albedo, 0, 1)), "normal": np.ascontiguousarray(normal)}
    return np.array(pyoidn.denoise(np.ascontiguousarray(picture), hdr=True, **guides), np.float32)


@cache
def _mitsuba() -> Any:
    import mitsuba

    mitsuba.set_variant(variant())
    mitsuba.set_log_level(mitsuba.LogLevel.Error)
    return mitsuba


def _rgb(colour: Any) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(part) for part in colour]}


def _bitmap(texture: NDArray[np.float32]) -> dict[str, Any]:
    # The first row of a texture is its top, but v points up.
    data = np.ascontiguousarray(texture[::-1] if texture.ndim == 3 else texture[::-1, :, None], np.float32)
    return {"type": "bitmap", "data": _mitsuba().TensorXf(data), "raw": True}


def _reflectance(material: Material, factor: float = 1.0) -> dict[str, Any]:
    if material.texture is not None:
        return _bitmap(material.texture * np.float32(factor))
    return _rgb(np.array(material.colour) * factor)


@cache
def _puddles() -> NDArray[np.float32]:
    """Roughness of a wet road: films of water on damp asphalt."""
    share = np.clip((noise(1024, np.random.default_rng(5), 5, 6) - 0.42) * 4, 0, 1)
    return (0.07 + 0.33 * share).astype(np.float32)


def _bsdf(material: Material, wet: bool) -> dict[str, Any]:
    kind = material.kind
    if kind == "metal":
        tint = {"type": "rgb", "value": [float(part) for part in material.colour]}
        surface: dict[str, Any] = {
            "type": "roughconductor",
            "material": "Al",
            "alpha": 0.35,
            "specular_reflectance": tint,
        }
    elif kind in ("paint", "glass"):
        coat = {"clearcoat": 1.0, "clearcoat_gloss": 0.95} if kind == "paint" else {}
        rough, specular = (0.35, 0.5) if kind == "paint" else (0.08, 0.8)
        surface = {"type": "principled", "base_color": _reflectance(material), "roughness": rough} | coat
        surface["specular"] = specular
    elif kind == "road":
        surface = {"type": "principled", "base_color": _reflectance(material, 0.45 if wet else 1.0)}
        surface |= {"roughness": _bitmap(_puddles()) if wet else 0.75, "specular": 0.6 if wet else 0.3}
    elif kind == "paving" and wet:
        surface = {"type": "principled", "base_color": _reflectance(material, 0.6), "roughness": 0.3, "specular": 0.5}
    elif kind == "lamp":
        surface = {"type": "diffuse", "reflectance": _rgb((0, 0, 0))}
    else:
        surface = {"type": "diffuse", "reflectance": _reflectance(material, 0.8 if wet else 1.0)}
    return {"type": "twosided", "surface": surface}


def _shape(
    name: str, mesh: Mesh, bsdf: dict[str, Any], emitter: dict[str, Any] | None = None, smooth: bool = False
) -> Any:
    mi = _mitsuba()
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    if emitter:
        props["emitter"] = mi.load_dict(emitter)
    shape = mi.Mesh(
        name,
        len(mesh.vertices),
        len(mesh.triangles),
        has_vertex_normals=smooth,
        has_vertex_texcoords=True,
        props=props,
    )
    params = mi.traverse(shape)
    params["vertex_positions"] = mesh.vertices.ravel()
    params["vertex_texcoords"] = mesh.uv.ravel()
    params["faces"] = mesh.triangles.ravel()
    params.update()
    if smooth:
        shape.recompute_vertex_normals()
    return shape


def _face(x: float) -> Mesh:
    """The face of the sign with its texture coordinates."""
    corners = sign.corners(x)
    fan = [[0, i, i + 1] for i in range(1, 7)]
    uv = (corners[:, ::2] - (x, sign.HEIGHT_M)) / sign.SIZE_M + 0.5
    return Mesh(corners.astype(np.float32), np.array(fan, np.uint32), uv.astype(np.float32))


def _sensor(camera: Camera, window: tuple[int, int, int, int] | None, finer: int = 1) -> dict[str, Any]:
    mi = _mitsuba()
    film: dict[str, Any] = {"type": "hdrfilm", "width": finer * camera.width, "height": finer * camera.height}
    film |= {"pixel_format": "rgb", "component_format": "float32", "rfilter": {"type": "box"}}
    if window is not None:
        x0, y0, x1, y1 = window
        film |= {"crop_offset_x": x0, "crop_offset_y": y0, "crop_width": x1 - x0, "crop_height": y1 - y0}
    position = camera.position
    to_world = mi.ScalarTransform4f().look_at(
        origin=position.tolist(), target=(position + camera.forward).tolist(), up=[0, 0, 1]
    )
    return {
        "type": "perspective",
        "fov": camera.field_of_view_deg,
        "fov_axis": "x",
        "near_clip": 0.05,
        "far_clip": 2000.0,
        "to_world": to_world,
        "film": film,
        "sampler": {"type": "independent"},
    }


def _scene(parts: list[Part], light: Light, camera: Camera, sign_x: float) -> dict[str, Any]:
    mi = _mitsuba()
    scene: dict[str, Any] = {"type": "scene"}
    for number, (mesh, material) in enumerate(parts):
        glow = {"type": "area", "radiance": _rgb(material.colour)} if material.kind == "lamp" else None
        scene[f"part{number}"] = _shape(
            f"part{number}", mesh, _bsdf(material, light.wet), glow, material.kind in ("paint", "glass")
        )
    sky = light.sky
    if light.sun is not None:
        sky, irradiance = _clear_sky(tuple(light.sun.tolist()))
        direction = [float(-part) for part in light.sun]
        scene["sun"] = {"type": "directional", "direction": direction, "irradiance": _rgb(irradiance)}
    assert sky is not None
    upright = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    scene["sky"] = {"type": "envmap", "bitmap": mi.Bitmap(sky), "to_world": upright}
    if light.headlights:
        scene |= _headlights(camera) | _street_lamps()
    return scene


@cache
def _clear_sky(sun: tuple[float, float, float]) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Radiance [H, W, 3] of a clear sky, laid out as `Light.sky`, and irradiance [3] of its sun.

    Mitsuba's model of both (Hosek and Wilkie 2012, 2013) costs more per sample than the rest of the scene; as a map and a
    parallel beam they cost almost nothing.
    """
    height = 128
    polar, azimuth = np.meshgrid(
        (np.arange(height) + 0.5) / height * np.pi, (np.arange(2 * height) + 0.5) / height * np.pi, indexing="ij"
    )
    directions = np.stack([np.sin(polar) * np.sin(azimuth), np.sin(polar) * np.cos(azimuth), np.cos(polar)], -1)
    sky = _radiance({"sun_scale": 0.0}, sun, directions.reshape(-1, 3)).reshape(height, 2 * height, 3)
    # The model is black below the horizon, but the distant ground is not.
    sky[height // 2 :] = 0.3 * sky[height // 2 - 1].mean(0)
    disc = _radiance({"sky_scale": 0.0}, sun, np.array([sun]))[0]
    limb_darkening = 0.8
    return sky.astype(np.float32), disc * limb_darkening * 2 * np.pi * (1 - np.cos(np.deg2rad(0.2665)))


def _radiance(scales: dict[str, float], sun: tuple[float, float, float], towards: NDArray[np.float64]) -> Array:
    """Radiance [N, 3] of sun and sky from the directions [N, 3]."""
    mi = _mitsuba()
    emitter = mi.load_dict(
        {"type": "sunsky", "sun_direction": list(sun), "turbidity": 3.0, "albedo": 0.2, "sun_aperture": 0.533} | scales
    )
    if "llvm" in variant():
        si = mi.SurfaceInteraction3f()
        si.wi = mi.Vector3f(*(-towards.T.astype(np.float32)))
        return np.array(emitter.eval(si)).T.astype(float)
    found = []
    for direction in towards:
        si = mi.SurfaceInteraction3f()
        si.wi = mi.ScalarVector3f(*(-direction))
        found.append(np.array(emitter.eval(si)))
    return np.array(found)


def _headlights(camera: Camera) -> dict[str, Any]:
    mi = _mitsuba()
    found = {}
    for number, x in enumerate(lights.HEADLIGHTS_X):
        origin = _lamp(camera, x)
        found[f"headlight{number}"] = {
            "type": "projector",
            "irradiance": _bitmap(lights.low_beam()[::-1]),
            # The scale of the projector times pi is the intensity along its axis.
            "scale": lights.BEAM_PEAK_CD / np.pi,
            "fov": lights.BEAM_FIELD_DEG,
            "to_world": mi.ScalarTransform4f().look_at(
                origin=origin.tolist(), target=(origin + np.array([0, 1, 0])).tolist(), up=[0, 0, 1]
            ),
        }
    return found


def _street_lamps() -> dict[str, Any]:
    mi = _mitsuba()
    return {
        f"street_lamp{number}": {
            "type": "spot",
            "intensity": _rgb(lights.LAMP_CD * np.array([1.0, 0.85, 0.62])),
            "cutoff_angle": 75.0,
            "beam_width": 55.0,
            "to_world": mi.ScalarTransform4f().look_at(origin=[x, y, z], target=[x, y + 0.01, 0], up=[0, 1, 0]),
        }
        for number, (x, y, z) in enumerate(lamp_heads())
    }
