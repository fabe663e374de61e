"""A decoded frame: renders any texture on its sign, differentiably."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavbench.detection.colour import linear
from cavbench.detection.mount import Spot
from cavbench.envs.camera import develop, sign
from cavbench.envs.camera.bare import Post, post_of, without_sign
from cavbench.envs.camera.camera import Array, Camera
from cavbench.envs.camera.faces import Face
from cavbench.envs.camera.frame import GAMMA, Frame
from cavbench.errors import UserError

SUPERSAMPLING = 4
"""Texture samples along the side of a pixel."""
LEAST_GAIN = 0.03
"""Pixels that gain a smaller share of the largest gain do not show the sign: it is hidden there, or lights them indirectly."""

Box = tuple[int, int, int, int]
"""x0, y0, x1, y1 in pixels of the image."""
Samples = tuple[NDArray[np.float32], Tensor]
"""Where the samples of pixels are on the face [h * S, w * S, 2], and their weights [h * S, w * S]; S is `SUPERSAMPLING`."""


@dataclass(frozen=True, eq=False)
class Plate:
    """The parts of a frame that do not depend on the texture.

    Args:
        picture: uint8 [3, H, W], developed, with a black sign, without sensor noise.
        crop: box around the sign; empty if the sign is outside.
        black, gain: float32 [3, h, w] on the crop; the exposed light is black + gain * texture.
        printed: share of the gain that a print on the sign has, for each colour.
        face_from_pixel: homography [3, 3] (`sign.pixel_to_face`).
        post: where the post is in the image.
    """

    picture: Tensor
    crop: Box
    black: Tensor
    gain: Tensor
    printed: sign.Colour
    face_from_pixel: Array
    post: Post

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
        (shown,) = signed(face, [(self, part)])
        return shown

    def carrying(self, face: Face) -> Tensor:
        """The whole image with a decoy on the post, float32 [3, H, W]; where its plate is not, the background is filled in."""
        picture = self.picture / 255
        if common(self.crop):
            side = detail(self.crop)
            light, cover = (
                texture_mean(self.crop, filtered(part[None], side)[0], self.face_from_pixel)
                for part in (face.reflectance, face.cover)
            )
            shown = self.black + self.gain * light
            mixed = cover * shown + (1 - cover) * self.bare
            picture[within(self.crop, (0, 0, 0, 0))] = develop.tone(torch.where(self.lit, mixed, shown))
        return picture

    def samples(self, part: Box) -> Samples:
        """As `_weighted`; those of the latest part are kept, because a patch is rendered at its place again and again."""
        if part not in self._kept:
            self._kept.clear()
            self._kept[part] = _weighted(part, self.face_from_pixel)
        return self._kept[part]

    @cached_property
    def _kept(self) -> dict[Box, Samples]:
        return {}

    @cached_property
    def lit(self) -> Tensor:
        """The pixels of the crop that show the sign, bool [h, w]."""
        gain = self.gain.amax(0)
        return (gain > LEAST_GAIN * gain.max()) & torch.from_numpy(
            _inside(self.crop, self.face_from_pixel)[1].any((1, 3))
        )

    @cached_property
    def bare(self) -> Tensor:
        """The exposed light of the crop without a sign, [3, h, w]: guessed from its surroundings."""
        filled = without_sign(self.picture.permute(1, 2, 0).numpy(), self.crop, self.lit.numpy(), self.post)
        return develop.light_of(torch.from_numpy(filled).permute(2, 0, 1) / 255)

    def beside(self, shown: Tensor, part: Box, patch: Tensor, spot: Spot) -> Tensor:
        """A part of the image with a patch on a plate of its own, in the plane of the sign; differentiable in the patch.

        What the frame does not hold is taken from the sign: the plate is lit and dimmed as the sign is on the whole, and nothing
        stands before it.

        Args:
            shown: the part without the plate, float32 [3, h, w].
            part: its box in the image.
            patch: sRGB in [0, 1], [3, P, P].
            spot: where the plate is in texture coordinates of the sign.
        """
        if not common(self.crop) or not self.lit.any():
            return shown
        left, top, right, bottom = spot
        corner, sides = np.array([left, top], np.float32), np.array([right - left, bottom - top], np.float32)
        place = (_sampled(part, self.face_from_pixel) - corner) / sides
        inside = torch.from_numpy(((place >= 0) & (place <= 1)).all(-1)).float()
        side = max(1, round((right - left) * detail(self.crop)))
        # As many texels as the face of the sign would have there: fewer are means, more are copies.
        mode = "area" if side < patch.shape[-1] else "nearest-exact"
        texels = torch.nn.functional.interpolate(linear(patch)[None], size=(side, side), mode=mode)[0]
        cover = torch.nn.functional.avg_pool2d(inside[None], SUPERSAMPLING)
        black, gain = (light[:, self.lit].median(1).values[:, None, None] for light in (self.black, self.gain))
        printed = torch.tensor(self.printed).view(3, 1, 1)
        light = cover * black + gain * printed * _mean_at(texels, place, inside)
        return torch.where(cover > 0, develop.tone(light + (1 - cover) * develop.light_of(shown)), shown)

    def cut(self, part: Box) -> Tensor:
        """A part of the image with the plain sign, float32 [3, h, w]."""
        picture = self.picture[within(part, (0, 0, 0, 0))] / 255
        if here := common(part, self.crop):
            picture[within(here, part)] = self.plain[within(here, self.crop)]
        return picture


def opened(kept: Frame, camera: Camera, x: float) -> Plate:
    """Decode a frame of a camera, with the sign at `x` in m.

    Raises:
        UserError: if its picture cannot be decoded.
    """
    picture = cv2.imdecode(kept.picture, cv2.IMREAD_COLOR_RGB)
    if picture is None:
        raise UserError("the picture of a frame cannot be decoded; `bench render` makes the frames again")
    black, gain = (
        most * (torch.from_numpy(code).permute(2, 0, 1) / 255) ** GAMMA
        for code, most in zip((kept.black, kept.gain), kept.scale, strict=True)
    )
    planes = torch.from_numpy(picture).permute(2, 0, 1).contiguous()
    return Plate(planes, kept.crop, black, gain, kept.printed, sign.pixel_to_face(x, camera), post_of(camera, x))


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
    place, weight = _weighted(part, face_from_pixel)
    return _mean_at(face, place, weight)


def signed(face: Tensor, parts: Sequence[tuple[Plate, Box]]) -> list[Tensor]:
    """Developed parts [3, h, w] of the crops of plates with one texture on their signs; differentiable in the texture.

    Args:
        face: linear reflectances of the whole face [3, S, S], with S = `detail(crop)` of all plates.
        parts: a plate and a non-empty box inside its crop each.
    """
    samples = [plate.samples(part) for plate, part in parts]
    shown = []
    for (plate, part), mean in zip(parts, _means_at(face, samples), strict=True):
        here = within(part, plate.crop)
        shown.append(develop.tone(plate.black[here] + plate.gain[here] * mean))
    return shown


def _weighted(part: Box, face_from_pixel: Array) -> Samples:
    """The samples of the pixels of a part; their weights are 0 beyond the octagon."""
    place, inside = _inside(part, face_from_pixel)
    cover = inside.mean((1, 3), np.float32, keepdims=True)
    # Where the tracer saw a corner of the sign but no sample hits it, the border texel is used.
    weight = np.where(cover > 0, inside / np.maximum(cover, 1e-6), np.float32(1)).reshape(place.shape[:2])
    return place, torch.from_numpy(weight)


def _mean_at(texels: Tensor, place: NDArray[np.float32], weight: Tensor) -> Tensor:
    """Weighted mean of texels [3, S, S] over the samples of each pixel, [3, h, w].

    Args:
        texels: of a unit square.
        place: where the samples are on it, [h * SUPERSAMPLING, w * SUPERSAMPLING, 2].
        weight: of the samples, [h * SUPERSAMPLING, w * SUPERSAMPLING].
    """
    (mean,) = _means_at(texels, [(place, weight)])
    return mean


def _means_at(texels: Tensor, samples: Sequence[Samples]) -> list[Tensor]:
    """As `_mean_at`, for the samples of several parts: the texels are read once, and have one gradient."""
    grid = np.concatenate([place.reshape(-1, 2) for place, _ in samples])
    found = torch.nn.functional.grid_sample(
        texels.unsqueeze(0),
        torch.from_numpy(2 * grid - 1)[None, :, None],
        mode="bilinear",
        padding_mode="border",
        align_corners=False,
    )
    parts = found[0, :, :, 0].split([weight.numel() for _, weight in samples], 1)
    return [
        torch.nn.functional.avg_pool2d(part.unflatten(1, weight.shape) * weight, SUPERSAMPLING)
        for part, (_, weight) in zip(parts, samples, strict=True)
    ]


def wholly_sign(part: Box, face_from_pixel: Array) -> Tensor:
    """Which pixels show nothing but the sign, bool [h, w]."""
    return torch.from_numpy(_inside(part, face_from_pixel)[1].all((1, 3)))


def _inside(part: Box, face_from_pixel: Array) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Where the samples of the pixels are on the face [h * S, w * S, 2], and whether on the octagon [h, S, w, S]."""
    place = _sampled(part, face_from_pixel)
    return place, sign.inside(place).reshape(part[3] - part[1], SUPERSAMPLING, part[2] - part[0], SUPERSAMPLING)


def _sampled(part: Box, face_from_pixel: Array) -> NDArray[np.float32]:
    """Where the samples of the pixels are on the face [h * S, w * S, 2]."""
    x0, y0, x1, y1 = part
    step = 1 / SUPERSAMPLING
    u, v = (np.arange(low + step / 2, high, step, dtype=np.float32) for low, high in ((x0, x1), (y0, y1)))
    across, down, scale = (a * u + (b * v + c)[:, None] for a, b, c in face_from_pixel.tolist())
    return np.stack((across / scale, down / scale), -1)


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
