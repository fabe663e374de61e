"""The world `windscreen` as a component: the frames of `camera` through drops, glare or motion blur."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from cavbench.detection import Approach, Decoy, Objects, Scenes
from cavbench.envs.camera import develop
from cavbench.envs.camera.bank import BankScenes
from cavbench.envs.camera.bank_world import BankWorld
from cavbench.envs.camera.lens import EFFECTS
from cavbench.envs.camera.poses import Pose
from cavbench.envs.camera.windscreen_axes import AXES, LENSES, WINDSCREEN_V1
from cavbench.envs.camera.world import StopSignApproach
from cavbench.envs.weather import WEATHERS
from cavbench.scenarios import Axes, Cell


class WindscreenScenes(Scenes):
    """Frames of the bank, changed in linear light before the sensor noise.

    Args:
        street: the frames.
        lenses: of each frame, a value of the axis `lens`.
    """

    def __init__(self, street: BankScenes, lenses: Sequence[str]) -> None:
        self.street, self.lenses = street, tuple(lenses)
        self.size, self.decoys, self.faces = street.size, street.decoys, street.faces
        self.boxes, self.visible, self.distance = street.boxes, street.visible, street.distance

    def objects(self, frame: int) -> Objects:
        return self.street.objects(frame)

    def redrawn(self, number: int, like_signs: bool = False) -> Scenes:
        return WindscreenScenes(self.street.redrawn(number, like_signs), self.lenses)

    def with_decoys(self, decoys: Sequence[Decoy]) -> Scenes:
        return WindscreenScenes(self.street.with_decoys(decoys), self.lenses)

    def render(self, frames: Tensor, patches: Tensor | None, share: float) -> Tensor:
        return self._seen(self.street.developed(frames, patches, share), frames)

    def render_decoys(self, frames: Tensor) -> Tensor:
        return self._seen(self.street.developed_decoys(frames), frames)

    def reach(self, share: float) -> Tensor:
        """The whole images: drops show the patch at other places, too."""
        height, width = self.size
        return torch.tensor([0.0, 0.0, width, height]).repeat(len(self), 1)

    def _seen(self, pictures: Tensor, frames: Tensor) -> Tensor:
        """Developed images [N, 3, H, W] of frames, as the camera takes them."""
        numbers = frames.tolist()
        for lens, effect in EFFECTS.items():
            places = [place for place, number in enumerate(numbers) if self.lenses[number] == lens]
            if places:
                poses = [self.street.poses[numbers[place]] for place in places]
                weathers = [WEATHERS[self.street.weathers[numbers[place]]] for place in places]
                chosen = torch.tensor(places)
                light = effect(develop.light_of(pictures[chosen]), poses, weathers)
                pictures = pictures.index_copy(0, chosen, develop.tone(light))
        return self.street.with_noise(pictures, frames)


@dataclass(frozen=True, kw_only=True)
class Windscreen(BankWorld):
    """The approaches of `camera`, seen through drops on the windscreen, veiling glare of a low sun, or motion blur.

    Args:
        bank: folder of the rendered frames; empty for the shipped frames.
    """

    title: ClassVar[str] = "windscreen"
    axes: ClassVar[Axes] = AXES
    mounts: ClassVar[bool] = False
    grid: ClassVar[str] = WINDSCREEN_V1.name
    locations: ClassVar[tuple[str, ...]] = StopSignApproach.locations

    def training_scenes(self) -> Scenes:
        """Those of the world `camera`; each frame has one of the lenses, in turn."""
        street = self._street.training_scenes()
        return WindscreenScenes(street, [LENSES[number % len(LENSES)] for number in range(len(street))])

    def approaches(self, cell: Cell, seeds: range) -> list[Approach]:
        found = []
        for seed in seeds:
            street = self._street.scenes(cell, seed)
            scenes = WindscreenScenes(street, [cell.lens] * len(street))
            found.append(Approach(seed=seed, location=self.place(seed), scenes=scenes))
        return found

    @property
    def _street(self) -> StopSignApproach:
        return StopSignApproach(bank=self.bank)

    def every_pose(self) -> tuple[Pose, ...]:
        return self._street.every_pose()
