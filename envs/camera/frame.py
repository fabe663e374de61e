"""One frame of the bank: a developed picture, and on the sign's crop the light that a texture is put into.

On the crop the light is L = black + gain * texture, exposed and with the weather's air in it (`envs.camera.weather`); the
texture is its mean over the part of a pixel's footprint that is sign.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bench.scenario import Weather
from bench.stopping import SPEED_MPS
from envs.camera import develop, sign
from envs.camera.camera import Camera
from envs.camera.poses import Pose
from envs.camera.street.layout import sign_x
from envs.camera.street.light import lighting
from envs.camera.street.render import Traced
from envs.camera.weather import air

QUALITY = 85
"""Of the WebP picture; the sign's crop does not go through it."""
GAMMA = 2.2
"""The crop's light is kept in 8 bits like a picture: (value / largest) ** (1 / GAMMA)."""
SUPERSAMPLING = 4
"""Samples along a pixel's side that a texture's mean is taken over."""


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame as it is kept.

    Args:
        picture: WebP of the developed frame with a black sign, without the sensor's noise.
        crop: x0, y0, x1, y1 around the sign in pixels, within the picture; empty if the sign is outside.
        black, gain: uint8 [h, w, 3], coded as `GAMMA` says.
        scale: what codes of 255 stand for in black and gain.
        visible: share of the sign that is in the picture and not hidden, in [0, 1].
    """

    picture: NDArray[np.uint8]
    crop: tuple[int, int, int, int]
    black: NDArray[np.uint8]
    gain: NDArray[np.uint8]
    scale: tuple[float, float]
    visible: float


def frame(traced: Traced, pose: Pose, weather: Weather) -> Frame:
    """A traced pose in a weather, developed."""
    x0, y0, x1, y1 = traced.crop
    between = air(weather, traced.depth, traced.black, SPEED_MPS, pose.camera.focal, pose.seed)
    light = traced.black * between.transmitted + between.added
    factor = develop.exposure(light)
    picture = develop.tone(torch.from_numpy(light * factor)).numpy()
    done, webp = cv2.imencode(
        ".webp", np.rint(255 * picture[..., ::-1]).astype(np.uint8), [cv2.IMWRITE_WEBP_QUALITY, QUALITY]
    )
    assert done
    black, most_black = _coded(light[y0:y1, x0:x1] * factor)
    gain, most_gain = _coded(traced.gain * between.transmitted[y0:y1, x0:x1] * factor)
    whole = cv2.contourArea(pose.camera.project(sign.corners(sign_x(pose.lanes))).astype(np.float32))
    visible = min(1.0, float(traced.coverage.sum()) / whole)
    return Frame(webp.ravel(), traced.crop, black, gain, (most_black, most_gain), visible)


def _coded(light: NDArray[np.float32]) -> tuple[NDArray[np.uint8], float]:
    most = float(light.max(initial=1e-6))
    return np.rint(255 * (light.clip(0) / most) ** (1 / GAMMA)).astype(np.uint8), most


def noise_level(weather: Weather) -> float:
    """Standard deviation of the sensor's noise, on the sRGB scale."""
    return develop.NOISE[lighting(weather)]


def background(kept: Frame) -> Tensor:
    """[3, H, W] the developed picture with a black sign."""
    decoded = cv2.imdecode(kept.picture, cv2.IMREAD_COLOR)
    assert decoded is not None
    return torch.from_numpy(decoded[..., ::-1].copy()).permute(2, 0, 1).float() / 255


def signed(kept: Frame, face: Tensor, camera: Camera, x: float) -> Tensor:
    """[3, h, w] the developed crop with a texture on the sign, differentiable to it.

    Args:
        kept: the frame; its crop must not be empty.
        face: linear reflectances of the whole face [3, S, S].
        camera: of the frame.
        x: where the sign stands.
    """
    x0, _, x1, _ = kept.crop
    black, gain = (
        most * (torch.from_numpy(code).permute(2, 0, 1) / 255) ** GAMMA
        for code, most in zip((kept.black, kept.gain), kept.scale, strict=True)
    )
    return develop.tone(black + gain * _texture_mean(kept.crop, filtered(face, x1 - x0), camera, x))


def _texture_mean(crop: tuple[int, int, int, int], face: Tensor, camera: Camera, x: float) -> Tensor:
    """[3, h, w] mean of the face's texture over the part of each pixel that is sign."""
    x0, y0, x1, y1 = crop
    step = 1 / SUPERSAMPLING
    rows, columns = torch.arange(y0 + step / 2, y1, step), torch.arange(x0 + step / 2, x1, step)
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    homography = torch.from_numpy(sign.pixel_to_face(x, camera)).float()
    place = torch.stack((u, v, torch.ones_like(u)), -1) @ homography.T
    place = place[..., :2] / place[..., 2:]
    inside = torch.from_numpy(sign.inside(place.numpy())).float()
    found = torch.nn.functional.grid_sample(
        face.unsqueeze(0), 2 * place.unsqueeze(0) - 1, mode="bilinear", padding_mode="border", align_corners=False
    )
    total = torch.nn.functional.avg_pool2d(found * inside, SUPERSAMPLING)
    cover = torch.nn.functional.avg_pool2d(inside[None, None], SUPERSAMPLING)
    # Where the tracer saw a corner of the sign and no sample hits it, the border's texel does.
    anywhere = torch.nn.functional.avg_pool2d(found, SUPERSAMPLING)
    return torch.where(cover > 0, total / cover.clamp(min=1e-6), anywhere)[0]


def filtered(face: Tensor, width: float) -> Tensor:
    """The linear face [3, S, S] averaged down so that about `SUPERSAMPLING` texels fall on a pixel of a sign `width` px wide."""
    side = face.shape[-1]
    while side > 32 and side // 2 >= SUPERSAMPLING * width:
        side //= 2
    return torch.nn.functional.avg_pool2d(face, face.shape[-1] // side) if side < face.shape[-1] else face
