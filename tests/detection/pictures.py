"""A drawn street with a stop sign, good enough for a detector trained on photographs."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

SHARP = 8
"""Bits of sub-pixel precision that cv2 draws with."""


def stop_sign(size: float = 120, *, side: int = 640, x: float = 0.6, y: float = 0.4) -> tuple[Tensor, Tensor]:
    """A picture [3, side, side] in [0, 1] and the box [4] of the sign, which is `size` pixels wide.

    Args:
        size: width of the sign in pixels.
        side: of the picture in pixels.
        x, y: centre of the sign as shares of the side.
    """
    horizon = side // 2
    picture = np.empty((side, side, 3))
    picture[:horizon] = np.linspace((110, 160, 210), (200, 215, 230), horizon)[:, None]
    picture[horizon:] = np.linspace((80, 110, 70), (60, 95, 50), side - horizon)[:, None]
    road = np.array([(0.45, 0.5), (0.52, 0.5), (0.9, 1), (-0.1, 1)]) * side
    cv2.fillPoly(picture, [road.astype(np.int32)], (105, 105, 105), cv2.LINE_AA)
    picture += np.random.default_rng(0).normal(0, 4, picture.shape)

    middle = np.array([x, y]) * side
    foot = np.array([(-0.04, 0), (0.04, 0), (0.04, 3), (-0.04, 3)]) * size + middle
    cv2.fillPoly(picture, [foot.astype(np.int32)], (145, 145, 140))
    for width, colour in ((1.0, (240, 240, 240)), (0.93, (178, 28, 38))):
        angles = np.pi / 8 + np.arange(8) * np.pi / 4
        corners = np.stack((np.cos(angles), np.sin(angles)), 1) * width * size / 2 / np.cos(np.pi / 8) + middle
        cv2.fillPoly(picture, [(corners * 2**SHARP).astype(np.int32)], colour, cv2.LINE_AA, SHARP)
    _write(picture, "STOP", middle, size)

    picture = cv2.GaussianBlur(picture, (0, 0), 0.7).clip(0, 255) / 255
    box = torch.tensor([*(middle - size / 2), *(middle + size / 2)], dtype=torch.float32)
    return torch.from_numpy(picture).permute(2, 0, 1).float(), box


def _write(picture: np.ndarray, word: str, middle: np.ndarray, size: float) -> None:
    """White letters, as narrow as those of a road sign: drawn large, then squeezed."""
    large = np.zeros((500, 1400), np.uint8)
    cv2.putText(large, word, (60, 380), cv2.FONT_HERSHEY_SIMPLEX, 10, 255, 56, cv2.LINE_AA)
    rows, columns = np.nonzero(large)
    large = large[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    letters = cv2.resize(large, (round(size * 0.78), round(size * 0.34)), interpolation=cv2.INTER_AREA)[..., None] / 255
    left, top = (middle - np.array(letters.shape[1::-1]) / 2).astype(int)
    part = picture[top : top + letters.shape[0], left : left + letters.shape[1]]
    part[:] = part * (1 - letters) + 240 * letters
