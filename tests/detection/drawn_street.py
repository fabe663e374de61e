"""A camera world of simple drawings: an approach to a stop sign that a detector trained on photographs recognises."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from cavbench.detection import Approach, CameraWorld, Scenes
from cavbench.envs.camera.axes import AXES
from cavbench.envs.weather import WEATHERS
from cavbench.scenarios import Axes, Cell, Grid
from tests.detection.pictures import stop_sign

DRAWN_V1 = Grid(
    name="drawn-v1",
    world="drawn",
    axes=AXES,
    values={"lanes": (3,), "density": (1.0,), "weather": ("clear", "fog")},
    episodes=2,
)
SIDE = 416
PIXELS_M = 1040.0
"""Width of the sign in pixels times its distance in metres: 130 pixels at 8 m."""


class DrawnScenes(Scenes):
    """Frames at some distances, the sign at x (share of the width); fog is a grey veil."""

    size = (SIDE, SIDE)

    def __init__(self, distances: list[float], *, x: float, extinction_per_m: float = 0.0) -> None:
        drawn = [stop_sign(PIXELS_M / metres, side=SIDE, x=x) for metres in distances]
        self.distance = torch.tensor(distances)
        veil = 1 - torch.exp(-extinction_per_m * self.distance)[:, None, None, None]
        self.pictures = torch.stack([picture for picture, _ in drawn]) * (1 - veil) + 0.7 * veil
        self.veil = veil
        self.boxes = torch.stack([box for _, box in drawn])
        self.visible = torch.ones(len(drawn))

    def render(self, frames: Tensor, patches: Tensor | None, share: float) -> Tensor:
        pictures = self.pictures[frames]
        if patches is None:
            return pictures
        low, high = self.boxes[frames].split(2, -1)
        centre, half = (low + high) / 2, (high - low) / 2 * share
        pixels = torch.arange(SIDE) + 0.5
        places = torch.stack(torch.meshgrid(pixels, pixels, indexing="xy"), -1)
        places = (places - centre[:, None, None]) / half[:, None, None]
        inside = (places.abs().amax(-1) <= 1).unsqueeze(1)
        pasted = nn.functional.grid_sample(
            patches.expand(len(frames), -1, -1, -1), places, padding_mode="border", align_corners=False
        )
        veil = self.veil[frames]
        return torch.where(inside, pasted * (1 - veil) + 0.7 * veil, pictures)


@dataclass(frozen=True, kw_only=True)
class DrawnStreet(CameraWorld):
    """Ten frames from 30 to 8 metres, at one of two places."""

    axes: ClassVar[Axes] = AXES
    grid: ClassVar[str] = DRAWN_V1.name
    locations: ClassVar[tuple[str, ...]] = ("left", "right")

    def training_scenes(self) -> Scenes:
        return DrawnScenes([8.5, 11.0, 15.0, 22.0], x=0.5)

    def approaches(self, cell: Cell, seeds: range) -> list[Approach]:
        distances = torch.linspace(30, 8, 10).tolist()
        extinction = WEATHERS[cell.weather].extinction_per_m

        def one(seed: int) -> Approach:
            place = seed % len(self.locations)
            x = (0.35, 0.65)[place] + 0.01 * cell.lanes
            return Approach(
                seed=seed,
                location=self.locations[place],
                scenes=DrawnScenes(distances, x=x, extinction_per_m=extinction),
            )

        return [one(seed) for seed in seeds]
