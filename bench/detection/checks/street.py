"""Scenes and a detector for the checks of the detection track: a red sign on grey, and random weights."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from cavbench.detection import STOP_SIGN, Detector, Predictions, Scenes

SIDE, FRAMES, CELL = 96, 12, 16
PIXELS_M = 320.0
"""Width of the sign in pixels, multiplied by its distance in metres."""


class Street(Scenes):
    """A red square in the middle of a grey image, at 8 to 30 m."""

    size = (SIDE, SIDE)

    def __init__(self) -> None:
        self.distance = torch.linspace(8, 30, FRAMES)
        half = (PIXELS_M / self.distance / 2).unsqueeze(1)
        self.boxes = torch.cat((SIDE / 2 - half, SIDE / 2 - half, SIDE / 2 + half, SIDE / 2 + half), 1)
        self.visible = torch.ones(FRAMES)

    def render(self, frames: Tensor, patches: Tensor | None, share: float) -> Tensor:
        grey = torch.full((len(frames), 3, SIDE, SIDE), 0.5)
        places = self._places(frames)
        on_sign = (places.abs().amax(-1) <= 1).unsqueeze(1)
        pictures = torch.where(on_sign, torch.tensor([0.8, 0.1, 0.1])[:, None, None], grey)
        if patches is None:
            return pictures
        on_patch = (places.abs().amax(-1) <= share).unsqueeze(1)
        textures = patches.expand(len(frames), -1, -1, -1)
        pasted = nn.functional.grid_sample(textures, places / share, padding_mode="border", align_corners=False)
        return torch.where(on_patch, pasted, pictures)

    def _places(self, frames: Tensor) -> Tensor:
        """Position [N, H, W, 2] of every pixel relative to the sign, whose edges are at -1 and 1."""
        middle = torch.arange(SIDE) + 0.5 - SIDE / 2
        pixels = torch.stack(torch.meshgrid(middle, middle, indexing="xy"), -1)
        return pixels / (PIXELS_M / self.distance[frames] / 2)[:, None, None, None]


class SignDetector(Detector):
    """One box per cell of the image; its score is high for red and, by random weights, depends on the texture."""

    names = ("car", STOP_SIGN)
    stride = CELL

    def __init__(self) -> None:
        super().__init__()
        self.kernel = nn.Conv2d(3, 1, CELL, CELL)
        weights = torch.randn(self.kernel.weight.shape, generator=torch.Generator().manual_seed(0)) / CELL**2
        red = torch.tensor([1.0, -0.5, -0.5])[:, None, None] * 4 / CELL**2
        with torch.no_grad():
            self.kernel.weight.copy_(weights + red)
            self.kernel.bias.zero_()  # type: ignore[union-attr]
        self.requires_grad_(False).eval()

    def predict(self, pictures: Tensor) -> Predictions:
        seen = self.kernel(pictures)
        rows, columns = seen.shape[-2:]
        top, left = torch.meshgrid(torch.arange(rows) * CELL, torch.arange(columns) * CELL, indexing="ij")
        boxes = torch.stack((left, top, left + CELL, top + CELL), -1).flatten(0, 1).to(pictures)
        classes = torch.tensor([0.1, 0.9]).expand(len(pictures), rows * columns, 2)
        return Predictions(boxes.expand(len(pictures), -1, 4), seen[:, 0].flatten(1).sigmoid(), classes)
