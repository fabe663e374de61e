"""JPEG compression before a detector."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
import torch
from annotated_types import Interval
from torch import Tensor

from cavbench.detection import ImageFilter


@dataclass(frozen=True, kw_only=True)
class JPEG(ImageFilter):
    """JPEG compression of the detector's input (Das et al. 2018, "SHIELD").

    Args:
        quality: quality of the compression, from 1 to 100 (default 40).
    """

    quality: Annotated[int, Interval(ge=1, le=100)] = 40

    def filter(self, pictures: Tensor) -> Tensor:
        coded = (pictures.clamp(0, 1) * 255).round().byte().permute(0, 2, 3, 1).cpu().numpy()
        through = np.stack([self._through(picture) for picture in coded])
        return torch.from_numpy(through).permute(0, 3, 1, 2).to(pictures) / 255

    def _through(self, picture: np.ndarray) -> np.ndarray:
        """Encode an image [H, W, 3], uint8 RGB, as JPEG and decode it."""
        _, encoded = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, self.quality])
        decoded = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
        assert decoded is not None
        return np.ascontiguousarray(decoded[..., ::-1])
