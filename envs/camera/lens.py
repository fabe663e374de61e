"""Drops on the windscreen, veiling glare and motion blur: maps of the linear light of whole frames.

Drops and motion blur are linear in the light, glare is affine, so the texels of a patch keep their gradient. Everything random
comes from the seed of the pose, or of its place for glare.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache, lru_cache
from types import MappingProxyType

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, grid_sample, interpolate

from cavbench.detection.stopping import SPEED_MPS
from cavbench.envs.camera.camera import Camera
from cavbench.envs.camera.develop import MIDDLE_GREY
from cavbench.envs.camera.poses import Pose
from cavbench.envs.camera.street.layout import LOCATIONS
from cavbench.envs.weather import Weather

Array = NDArray[np.float64]
Effect = Callable[[Tensor, Sequence[Pose], Sequence[Weather]], Tensor]

GLASS_M, SLOPE_DEG = 0.06, 30.0
"""Distance of the windscreen to the camera, and its angle to the horizontal."""
APERTURE_M = 0.0017
"""Diameter of the aperture: F/2 at the focal length of the camera of KITTI (721 pixels of 4.65 micrometres)."""
WIPE_S = 3.0
"""Time between two wipes: 20 cycles a minute, the slowest setting of a wiper that FMVSS 104 (S4.1.1) allows."""
SHOWER_MM_H = 7.6
"""Rate of the rain whose last drops are on the glass where it does not rain: the upper end of moderate rain (AMS, Glossary of
Meteorology, "Rain")."""
SMALLEST_MM, LARGEST_MM = 0.5, 6.0
"""Diameters of the falling drops that are drawn: those of rain; smaller ones are drizzle (the same)."""
CONTACT_DEG, WATER = 40.0, 1.33
"""Contact angle of water on glass, and its refractive index."""
RUN = (1.0, 1.6)
"""Length of a drop along the glass over its width, from round to one that has run down."""
STEP, BLURRED = 4, 32
"""Drops are drawn at one in `STEP` pixels, and show the street averaged over squares of `BLURRED` pixels."""
SUN_AZIMUTH_DEG, SUN_ELEVATION_DEG = (-25.0, 25.0), (16.0, 25.0)
"""Ranges of the direction of the low sun: near the driving direction, above the image."""
SUN_LX, STREET_CD_M2 = 70_000.0, 3_000.0
"""Illuminance by a sun at 20 degrees, normal to its rays, and the luminance that the exposure makes middle grey."""
EXPOSURE_S, SAMPLES = 1 / 30, 9
"""Exposure time of the blurred frames: all of it at 30 images a second, as in twilight; and instants of it that are averaged."""


def drops(light: Tensor, poses: Sequence[Pose], weathers: Sequence[Weather]) -> Tensor:
    """Drops on the windscreen: each refracts the street, shrunk and upside down, and is out of focus.

    There are as many as fall between two wipes at the rain rate of the weather, or after a shower (`SHOWER_MM_H`) where it does
    not rain.

    As Halimeh and Roser (2009, "Raindrop detection on car windshields using geometric-photometric environment construction and
    intensity-based correlation"), drops are spherical caps on a sloped glass, and light is refracted by Snell's law. The camera
    is focused on the street: rays that miss the drops draw it sharply, the others are spread over the disc of the aperture.

    Args:
        light: linear light [N, 3, H, W], H and W multiples of 32.
        poses: of the N frames.
        weathers: of the N frames.
    """
    rates = [weather.precipitation_mm_h or SHOWER_MM_H for weather in weathers]
    sheets = [_sheet(pose, rate) for pose, rate in zip(poses, rates, strict=True)]
    covered, sources = (torch.stack(parts) for parts in zip(*sheets, strict=True))
    shown = grid_sample(avg_pool2d(light, BLURRED), sources, padding_mode="border", align_corners=False)
    layers = _defocused(torch.cat((covered, covered * shown), 1))
    covered, shown = interpolate(layers, scale_factor=STEP, mode="bilinear").split((1, 3), 1)
    return light * (1 - covered) + shown


def glare(light: Tensor, poses: Sequence[Pose], weathers: Sequence[Weather]) -> Tensor:
    """Veiling glare of a low sun above the image: 10 E / theta^2 is added (Stiles and Holladay; Vos 1984; CIE 146:2002).

    E is the illuminance in lx, theta the angle to the sun in degrees, the veil a luminance in cd/m2.

    Args:
        light: linear light [N, 3, H, W].
        poses: of the N frames; frames of a place have the sun in the same direction.
        weathers: not used.
    """
    return light + torch.stack([_veil(pose) for pose in poses])


def blur(light: Tensor, poses: Sequence[Pose], weathers: Sequence[Weather]) -> Tensor:
    """Motion blur of the drive: the mean over the exposure, in which the image grows around the focus of expansion.

    The whole street is taken to be as far away as the sign, so the blur is right on the sign, too strong behind it and too weak
    before it.

    Args:
        light: linear light [N, 3, H, W].
        poses: of the N frames.
        weathers: not used.
    """
    height, width = light.shape[2:]
    size = torch.tensor([width, height])
    rows, columns = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    expansion = torch.from_numpy(np.stack([_expansion(pose.camera) for pose in poses])).float()[:, None, None]
    away = torch.stack((columns, rows), -1) - expansion
    distance = torch.tensor([pose.distance for pose in poses])[:, None, None, None]
    summed = torch.zeros_like(light)
    for instant in np.linspace(-0.5, 0.5, SAMPLES) * EXPOSURE_S:
        place = expansion + away * (1 - SPEED_MPS * float(instant) / distance)
        summed = summed + grid_sample(light, 2 * place / size - 1, padding_mode="border", align_corners=False)
    return summed / SAMPLES


EFFECTS: Mapping[str, Effect] = MappingProxyType({"drops": drops, "glare": glare, "blur": blur})
"""The effect of each value of the axis `lens` but `clean`."""


@lru_cache(maxsize=128)
def _sheet(pose: Pose, rate_mm_h: float) -> tuple[Tensor, Tensor]:
    """The drops of a frame at one in `STEP` pixels: where they are [1, h, w], and which places they show [h, w, 2]."""
    camera = pose.camera
    middles, halves = _drawn(pose, rate_mm_h)
    columns, rows = (torch.arange(STEP / 2, side, STEP) for side in (camera.width, camera.height))
    here = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1)
    # A drop far outside of the image, so that there is one.
    middles, halves = np.append(middles, [(-1e4, -1e4)], 0), np.append(halves, [(1.0, 1.0)], 0)
    middle, half = (torch.from_numpy(part).float()[:, None, None] for part in (middles, halves))
    offsets = (here - middle) / half
    radius, number = offsets.norm(dim=-1).min(0)
    offset = offsets.gather(0, number[None, ..., None].expand(1, -1, -1, 2))[0]
    narrow = half.amin(-1).flatten()[number]
    covered = ((1 - radius) * narrow / STEP + 0.5).clamp(0, 1)
    # Snell's law at a spherical cap, for a ray that leaves the glass at a right angle.
    tilt = radius.clamp(max=1) * np.sin(np.deg2rad(CONTACT_DEG))
    bent = camera.focal * torch.tan(torch.asin(WATER * tilt) - torch.asin(tilt))
    place = here - bent[..., None] * offset / radius.clamp(min=1e-3)[..., None]
    return covered[None], 2 * place / torch.tensor([camera.width, camera.height]) - 1


def _drawn(pose: Pose, rate_mm_h: float) -> tuple[Array, Array]:
    """Middles [K, 2] and half axes [K, 2] in pixels of the drops that are on the windscreen just before the next wipe.

    Falling drops have the sizes of Marshall and Palmer (1948) and the speeds of Atlas et al. (1973), as in
    `cavbench.envs.camera.weather.streaks`. Each becomes a spherical cap of the same volume.
    """
    camera, rng = pose.camera, np.random.default_rng([pose.seed, 1])
    per_mm = 4.1 * rate_mm_h**-0.21
    in_air = 8000 / per_mm * np.exp(-per_mm * SMALLEST_MM)
    fall = 9.65 - 10.3 * np.exp(-0.6 * (SMALLEST_MM + 1 / per_mm))
    area = camera.width * camera.height * (GLASS_M / camera.focal) ** 2
    # By the area that the camera sees, which is that of the glass times the sine of its slope.
    rate = in_air * (SPEED_MPS + fall / np.tan(np.deg2rad(SLOPE_DEG))) * area
    count = rng.poisson(rate * WIPE_S)
    diameter = np.minimum(SMALLEST_MM + rng.exponential(1 / per_mm, count), LARGEST_MM)
    sine, cosine = np.sin(np.deg2rad(CONTACT_DEG)), np.cos(np.deg2rad(CONTACT_DEG))
    base = diameter * np.cbrt(sine**3 / (2 * (2 - 3 * cosine + cosine**3)))
    across = base / 1000 / GLASS_M * camera.focal
    down = across * np.sin(np.deg2rad(SLOPE_DEG)) * rng.uniform(*RUN, count)
    middles = rng.uniform((0, 0), (camera.width, camera.height), (count, 2))
    return middles, np.stack((across, down), 1)


def _defocused(layers: Tensor) -> Tensor:
    """Layers [N, C, h, w] at one in `STEP` pixels, spread over the disc of the aperture."""
    disc = _disc()
    kernel = disc.expand(layers.shape[1], 1, -1, -1)
    return conv2d(layers, kernel, padding=disc.shape[-1] // 2, groups=layers.shape[1])


@cache
def _disc() -> Tensor:
    """The disc of the aperture seen at the windscreen, [k, k] with a sum of 1."""
    radius = APERTURE_M / GLASS_M * Camera(y=0.0).focal / STEP / 2
    reach = int(np.ceil(radius))
    place = torch.arange(-reach, reach + 1).float()
    disc = (radius + 0.5 - torch.hypot(place, place[:, None])).clamp(0, 1)
    return disc / disc.sum()


@lru_cache(maxsize=128)
def _veil(pose: Pose) -> Tensor:
    """The veil in a frame in units of exposed light, [1, H, W]."""
    camera, rng = pose.camera, np.random.default_rng([LOCATIONS[pose.location].seed, 2])
    azimuth, elevation = (np.deg2rad(rng.uniform(*span)) for span in (SUN_AZIMUTH_DEG, SUN_ELEVATION_DEG))
    sun = (np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation))
    right, down, forward = (float(part) for part in camera.rotation @ np.array(sun))
    x = (torch.arange(camera.width) + 0.5 - camera.width / 2) / camera.focal
    y = (torch.arange(camera.height)[:, None] + 0.5 - camera.height / 2) / camera.focal
    cosine = (x * right + y * down + forward) / torch.sqrt(x**2 + y**2 + 1)
    angle = torch.rad2deg(torch.acos(cosine.clamp(-1, 1))).clamp(min=1)
    return (MIDDLE_GREY / STREET_CD_M2 * 10 * SUN_LX / angle**2)[None]


def _expansion(camera: Camera) -> Array:
    """The focus of expansion [2] in pixels: where the driving direction is in the image."""
    return camera.project(camera.position[None] + np.array([(0.0, 1e6, 0.0)]))[0]
