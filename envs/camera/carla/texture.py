"""The texture of CARLA's stop sign: our face, with a patch or without."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import interpolate

from bench.errors import UserError
from envs.camera import sign

Region = tuple[float, float, float, float]
"""u1, v1, u2, v2 in shares of the texture, from its first column and row: where the face's left top and right bottom go."""
WHOLE: Region = (0.0, 0.0, 1.0, 1.0)


def stuck_on(patch: Tensor | None, share: float) -> NDArray[np.uint8]:
    """[TEXELS, TEXELS, 3] sRGB of our face, its first row the top, with a patch in its middle.

    Args:
        patch: [3, P, P] sRGB in [0, 1], or None.
        share: side of the patch in shares of the face's, in (0, 1].

    Raises:
        UserError: if the patch requires gradients.
    """
    if patch is not None and patch.requires_grad:
        raise UserError("CARLA gives no gradients: craft the patch in the embedded camera world, then score it here")
    face = torch.tensor(sign.face())
    if patch is not None:
        middle = sign.patch_texels(share)
        side = middle.stop - middle.start
        fitted = interpolate(patch[None].float().cpu(), (side, side), mode="bilinear", antialias=True)[0]
        face[:, middle, middle] = fitted
    return (face.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy()


def laid_out(face: NDArray[np.uint8], region: Region) -> NDArray[np.uint8]:
    """[T, T, 3] the whole texture of the sign, T = TEXELS, with the face [T, T, 3] in a region of it and red around.

    A region whose u1 is greater than u2 mirrors the face; v1 greater than v2 turns it upside down.
    """
    texels = len(face)
    (u1, v1, u2, v2) = (round(edge * texels) for edge in region)
    face = face[:: 1 if v2 > v1 else -1, :: 1 if u2 > u1 else -1]
    (top, bottom), (left, right) = sorted((v1, v2)), sorted((u1, u2))
    fitted = interpolate(
        torch.from_numpy(face.copy()).permute(2, 0, 1)[None].float(),
        (bottom - top, right - left),
        mode="bilinear",
        antialias=True,
    )
    texture = np.empty((texels, texels, 3), np.uint8)
    texture[:] = np.round(np.array(sign.RED) * 255)
    texture[top:bottom, left:right] = fitted[0].round().clamp(0, 255).byte().permute(1, 2, 0).numpy()
    return texture
