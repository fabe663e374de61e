"""One frame of the bank: a developed picture, and on the sign's crop the light that a texture is put into.

On the crop the light is L = black + gain * texture, exposed and with the weather's air in it (`envs.camera.weather`); the
texture is its mean over the part of a pixel's footprint that is sign.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bench.scenario import Weather
from bench.stopping import SPEED_MPS
from envs.camera import develop, sign
from envs.camera.camera import Array, Camera
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

Box = tuple[int, int, int, int]
"""x0, y0, x1, y1 in pixels of the picture."""


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame as it is kept.

    Args:
        picture: WebP of the developed frame with a black sign, without the sensor's noise.
        crop: around the sign, within the picture; empty if the sign is outside.
        black, gain: uint8 [h, w, 3], coded as `GAMMA` says.
        scale: what codes of 255 stand for in black and gain.
        visible: share of the sign that is in the picture and not hidden, in [0, 1].
    """

    picture: NDArray[np.uint8]
    crop: Box
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


@dataclass(frozen=True, eq=False)
class Plate:
    """A frame opened for patches: all of it that does not depend on them.

    Args:
        picture: uint8 [3, H, W], developed, with a black sign.
        crop: of the frame.
        black, gain: float32 [3, h, w] exposed light on the crop.
        face_from_pixel: homography [3, 3] (`sign.pixel_to_face`).
    """

    picture: Tensor
    crop: Box
    black: Tensor
    gain: Tensor
    face_from_pixel: Array

    @property
    def detail(self) -> int:
        """Side of the face's texture at which about `SUPERSAMPLING` texels fall on a pixel of the crop."""
        side, width = sign.TEXELS, self.crop[2] - self.crop[0]
        while side > 32 and side // 2 >= SUPERSAMPLING * width:
            side //= 2
        return side

    @cached_property
    def plain(self) -> Tensor:
        """float32 [3, h, w] the crop, developed, with the sign's own face."""
        return self.signed(filtered(sign.painted(None, 1.0), self.detail)[0], self.crop)

    def signed(self, face: Tensor, part: Box) -> Tensor:
        """[3, h, w] a part of the crop, developed, with a texture on the sign; differentiable to it.

        Args:
            face: linear reflectances of the whole face [3, S, S], S texels wide as `detail` says.
            part: within the crop, not empty.
        """
        here = within(part, self.crop)
        return develop.tone(self.black[here] + self.gain[here] * texture_mean(part, face, self.face_from_pixel))

    def window(self, window: Box) -> Tensor:
        """float32 [3, h, w] a part of the picture, with the sign's own face."""
        picture = self.picture[within(window, (0, 0, 0, 0))] / 255
        if part := common(window, self.crop):
            picture[within(part, window)] = self.plain[within(part, self.crop)]
        return picture


def opened(kept: Frame, camera: Camera, x: float) -> Plate:
    """The plate of a frame that a camera took, with the sign at `x`."""
    picture = cv2.imdecode(kept.picture, cv2.IMREAD_COLOR_RGB)
    assert picture is not None
    black, gain = (
        most * (torch.from_numpy(code).permute(2, 0, 1) / 255) ** GAMMA
        for code, most in zip((kept.black, kept.gain), kept.scale, strict=True)
    )
    planes = torch.from_numpy(picture).permute(2, 0, 1).contiguous()
    return Plate(planes, kept.crop, black, gain, sign.pixel_to_face(x, camera))


def common(*boxes: Box) -> Box | None:
    """The pixels that are in every box; None if there are none."""
    x0, y0, x1, y1 = zip(*boxes, strict=True)
    found = max(x0), max(y0), min(x1), min(y1)
    return found if found[0] < found[2] and found[1] < found[3] else None


def within(part: Box, whole: Box) -> tuple[slice, slice, slice]:
    """Where the pixels of `part` are in a tensor [3, h, w] of those of `whole`."""
    (x0, y0, x1, y1), (left, top, *_) = part, whole
    return slice(None), slice(y0 - top, y1 - top), slice(x0 - left, x1 - left)


def texture_mean(part: Box, face: Tensor, face_from_pixel: Array) -> Tensor:
    """[3, h, w] mean of the face's texture over the part of each pixel that is sign."""
    x0, y0, x1, y1 = part
    step = 1 / SUPERSAMPLING
    u, v = (np.arange(low + step / 2, high, step, np.float32) for low, high in ((x0, x1), (y0, y1)))
    across, down, scale = (a * u + (b * v + c)[:, None] for a, b, c in face_from_pixel.tolist())
    place = np.stack((across / scale, down / scale), -1)
    inside = sign.inside(place).reshape(len(v) // SUPERSAMPLING, SUPERSAMPLING, -1, SUPERSAMPLING)
    cover = inside.mean((1, 3), np.float32, keepdims=True)
    # Where the tracer saw a corner of the sign and no sample hits it, the border's texel does.
    weight = np.where(cover > 0, inside / np.maximum(cover, 1e-6), np.float32(1)).reshape(len(v), len(u))
    found = torch.nn.functional.grid_sample(
        face.unsqueeze(0),
        torch.from_numpy(2 * place - 1).unsqueeze(0),
        mode="bilinear",
        padding_mode="border",
        align_corners=False,
    )
    return torch.nn.functional.avg_pool2d(found * torch.from_numpy(weight), SUPERSAMPLING)[0]


def filtered(faces: Tensor, side: int) -> Tensor:
    """Linear faces [N, 3, S, S] averaged down to `side` texels."""
    step = faces.shape[-1] // side
    return torch.nn.functional.avg_pool2d(faces, step) if step > 1 else faces
