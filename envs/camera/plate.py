"""A decoded frame: renders any texture on its sign, differentiably."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from torch import Tensor

from envs.camera import develop, sign
from envs.camera.camera import Array, Camera
from envs.camera.frame import GAMMA, Frame

SUPERSAMPLING = 4
"""Texture samples along the side of a pixel."""

Box = tuple[int, int, int, int]
"""x0, y0, x1, y1 in pixels of the image."""


@dataclass(frozen=True, eq=False)
class Plate:
    """The parts of a frame that do not depend on the texture.

    Args:
        picture: uint8 [3, H, W], developed, with a black sign, without sensor noise.
        crop: box around the sign; empty if the sign is outside.
        black, gain: float32 [3, h, w] on the crop; the exposed light is black + gain * texture.
        face_from_pixel: homography [3, 3] (`sign.pixel_to_face`).
    """

    picture: Tensor
    crop: Box
    black: Tensor
    gain: Tensor
    face_from_pixel: Array

    @cached_property
    def plain(self) -> Tensor:
        """The developed crop with the plain sign, float32 [3, h, w]."""
        return self.signed(filtered(sign.painted(None, 1.0), detail(self.crop))[0], self.crop)

    def signed(self, face: Tensor, part: Box) -> Tensor:
        """A developed part of the crop [3, h, w] with a texture on the sign; differentiable in the texture.

        Args:
            face: linear reflectances of the whole face [3, S, S], with S = `detail(crop)`.
            part: a non-empty box inside the crop.
        """
        here = within(part, self.crop)
        return develop.tone(self.black[here] + self.gain[here] * texture_mean(part, face, self.face_from_pixel))

    def cut(self, part: Box) -> Tensor:
        """A part of the image with the plain sign, float32 [3, h, w]."""
        picture = self.picture[within(part, (0, 0, 0, 0))] / 255
        if here := common(part, self.crop):
            picture[within(here, part)] = self.plain[within(here, self.crop)]
        return picture


def opened(kept: Frame, camera: Camera, x: float) -> Plate:
    """Decode a frame of a camera, with the sign at `x` in m."""
    picture = cv2.imdecode(kept.picture, cv2.IMREAD_COLOR_RGB)
    assert picture is not None
    black, gain = (
        most * (torch.from_numpy(code).permute(2, 0, 1) / 255) ** GAMMA
        for code, most in zip((kept.black, kept.gain), kept.scale, strict=True)
    )
    planes = torch.from_numpy(picture).permute(2, 0, 1).contiguous()
    return Plate(planes, kept.crop, black, gain, sign.pixel_to_face(x, camera))


def common(*boxes: Box) -> Box | None:
    """The intersection of boxes; None if it is empty."""
    left, top, right, bottom = zip(*boxes, strict=True)
    x0, y0, x1, y1 = max(left), max(top), min(right), min(bottom)
    return (x0, y0, x1, y1) if x0 < x1 and y0 < y1 else None


def within(part: Box, whole: Box) -> tuple[slice, slice, slice]:
    """Slices that select the pixels of `part` from a tensor [3, h, w] of the pixels of `whole`."""
    (x0, y0, x1, y1), (left, top, *_) = part, whole
    return slice(None), slice(y0 - top, y1 - top), slice(x0 - left, x1 - left)


def texture_mean(part: Box, face: Tensor, face_from_pixel: Array) -> Tensor:
    """Mean of the texture over the part of each pixel that the sign covers, [3, h, w]."""
    x0, y0, x1, y1 = part
    step = 1 / SUPERSAMPLING
    u, v = (np.arange(low + step / 2, high, step, dtype=np.float32) for low, high in ((x0, x1), (y0, y1)))
    across, down, scale = (a * u + (b * v + c)[:, None] for a, b, c in face_from_pixel.tolist())
    place = np.stack((across / scale, down / scale), -1)
    inside = sign.inside(place).reshape(y1 - y0, SUPERSAMPLING, x1 - x0, SUPERSAMPLING)
    cover = inside.mean((1, 3), np.float32, keepdims=True)
    # Where the tracer saw a corner of the sign but no sample hits it, the border texel is used.
    weight = np.where(cover > 0, inside / np.maximum(cover, 1e-6), np.float32(1)).reshape(len(v), len(u))
    found = torch.nn.functional.grid_sample(
        face.unsqueeze(0),
        torch.from_numpy(2 * place - 1).unsqueeze(0),
        mode="bilinear",
        padding_mode="border",
        align_corners=False,
    )
    return torch.nn.functional.avg_pool2d(found * torch.from_numpy(weight), SUPERSAMPLING)[0]


def detail(crop: Box) -> int:
    """Width of the face in texels at which about `SUPERSAMPLING` texels fall on a pixel of the sign's crop."""
    side, width = sign.TEXELS, crop[2] - crop[0]
    while side > 32 and side // 2 >= SUPERSAMPLING * width:
        side //= 2
    return side


def filtered(faces: Tensor, side: int) -> Tensor:
    """Linear faces [N, 3, S, S] averaged down to `side` texels."""
    step = faces.shape[-1] // side
    return torch.nn.functional.avg_pool2d(faces, step) if step > 1 else faces
