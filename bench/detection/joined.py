"""The frames that an attacker knows: those of the scored approaches, each in the weathers that are known."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from itertools import product

import torch
from torch import Tensor

from cavbench.detection.contracts import CameraWorld
from cavbench.detection.detector import Objects
from cavbench.detection.mount import Mount
from cavbench.detection.scenes import Scenes
from cavbench.detection.threat import PatchThreat
from cavbench.errors import UserError
from cavbench.scenarios import Cell


class Joined(Scenes):
    """The frames of several scenes, one after the other.

    Args:
        parts: scenes with images of the same size.
    """

    def __init__(self, parts: Sequence[Scenes]) -> None:
        self.parts = tuple(parts)
        self.size = parts[0].size
        if any(part.size != self.size for part in parts):
            raise UserError(f"frames of several sizes cannot be joined: {sorted({part.size for part in parts})}")
        for name in ("boxes", "visible", "distance"):
            setattr(self, name, torch.cat([getattr(part, name) for part in parts]))
        self._part = torch.cat([torch.full((len(part),), number) for number, part in enumerate(parts)])
        self._within = torch.cat([torch.arange(len(part)) for part in parts])

    def apart(self) -> Scenes:
        other = super().apart()
        assert isinstance(other, Joined)
        other.parts = tuple(part.apart() for part in self.parts)
        return other

    def mounted(self, mount: Mount) -> Scenes:
        other = copy(self)
        other.mount, other.parts = mount, tuple(part.mounted(mount) for part in self.parts)
        return other

    def objects(self, frame: int) -> Objects:
        return self.parts[int(self._part[frame])].objects(int(self._within[frame]))

    def render(self, frames: Tensor, patches: Tensor | None, share: float) -> Tensor:
        corners = torch.zeros(len(frames), 2, dtype=torch.int64)
        return self.windows(frames, patches, share, corners, self.size)

    def windows(
        self, frames: Tensor, patches: Tensor | None, share: float, corners: Tensor, size: tuple[int, int]
    ) -> Tensor:
        shown: list[Tensor] = [torch.empty(0)] * len(frames)
        for number, part in enumerate(self.parts):
            mine = (self._part[frames] == number).nonzero().squeeze(1)
            if len(mine):
                own = patches if patches is None or len(patches) == 1 else patches[mine]
                found = part.windows(self._within[frames[mine]], own, share, corners[mine], size)
                for place, picture in zip(mine.tolist(), found, strict=True):
                    shown[place] = picture
        return torch.stack(shown)

    def reach(self, share: float) -> Tensor:
        return torch.cat([part.reach(share) for part in self.parts])


def sites(world: CameraWorld, threat: PatchThreat, cell: Cell, seeds: range) -> list[Scenes]:
    """The known frames of each approach, in the order of the seeds; none for an attacker who knows no site.

    Approaches with the same frames, which differ in the cross traffic alone, have the same scenes.

    Args:
        world: the world.
        threat: says what is known.
        cell: of the scored approaches.
        seeds: theirs.
    """
    if threat.knows == "universal":
        return []
    cells = [cell] if threat.knows == "scene" else _perceived(world, cell)
    by_cell = [[approach.scenes for approach in world.approaches(one, seeds)] for one in cells]
    found: dict[tuple[int, ...], Scenes] = {}
    keys = []
    for parts in zip(*by_cell, strict=True):
        keys.append(tuple(id(part) for part in parts))
        if keys[-1] not in found:
            found[keys[-1]] = parts[0] if len(parts) == 1 else Joined(parts)
    return [found[key] for key in keys]


def _perceived(world: CameraWorld, cell: Cell) -> list[Cell]:
    """The cell with every value of the axes that change only what is seen, such as the weather."""
    free = [axis for axis in world.facts.axes.axes if axis.perceptual and axis.choices]
    chosen = product(*(axis.choices or () for axis in free))
    return [cell.replaced(**{axis.name: value for axis, value in zip(free, values, strict=True)}) for values in chosen]
