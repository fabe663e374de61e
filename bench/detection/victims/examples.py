"""Training examples of detectors: windows with labelled objects, some of them with a decoy in the place of the stop sign."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from cavbench.detection import STOP_SIGN, Scenes
from cavbench.detection.victims.windows import Windows, kept

DRAWS = 6
"""How often all decoys are drawn; each frame has one decoy per draw."""


@dataclass(frozen=True)
class Example:
    """N windows [N, 3, side, side] with the boxes [K, 4] in pixels and the labels [K] of the objects in each."""

    pictures: Tensor
    boxes: list[Tensor]
    labels: list[Tensor]


class Examples:
    """Draws examples from training scenes.

    Args:
        scenes: the training scenes.
        windows: the windows.
        index: the label of a class name.
        decoys: share of the windows in whose frame a decoy stands in the place of the stop sign, in [0, 1].
        generator: random generator.
    """

    def __init__(
        self,
        scenes: Scenes,
        windows: Windows,
        index: Callable[[str], int],
        *,
        decoys: float,
        generator: torch.Generator,
    ) -> None:
        self.windows, self.index, self.generator = windows, index, generator
        self.share = decoys if scenes.decoys else 0.0
        drawn = (scenes.redrawn(number) for number in range(DRAWS if self.share else 0))
        self.decoys = [kept(one, one.render_decoys) for one in drawn]

    def draw(self, count: int) -> Example:
        """Draw `count` windows in random light. A decoy is no object."""
        views = self.windows.draw(count)
        pictures = self.windows.cut(views)
        boxes, labels = self.windows.objects(views, self.index)
        sign = self.index(STOP_SIGN)
        for number in self._chosen(count):
            one = views[torch.tensor([number])]
            drawn = self.decoys[int(torch.randint(DRAWS, (), generator=self.generator))]
            pictures[number] = self.windows.cut(one, drawn[one.frames])[0]
            others = labels[number] != sign
            boxes[number], labels[number] = boxes[number][others], labels[number][others]
        (lit,) = self.windows.lit(pictures)
        return Example(lit, boxes, labels)

    def _chosen(self, count: int) -> list[int]:
        """The windows with decoys; without any, no random number is drawn."""
        if not self.share:
            return []
        return (torch.rand(count, generator=self.generator) < self.share).nonzero().flatten().tolist()
