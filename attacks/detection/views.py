"""Views of the training places for the crafting of patches: windows around the sign, at random shifts."""

from __future__ import annotations

import torch
from torch import Tensor

from cavbench.detection import PatchOracle, Predictions, Scenes
from cavbench.errors import UserError

SEEN = 0.5
"""Frames in which a smaller share of the sign is visible are not used."""


class Views:
    """Random windows around the sign in scenes; `draw` comes first.

    Args:
        oracle: the attack's oracle, for its generator and threat model.
        scenes: the scenes to craft on.
        window: side in pixels of the square windows; smaller where the picture is.
        translation: largest shift of the sign, as a share of the window.

    Raises:
        UserError: if the detector takes no picture of that size.
    """

    def __init__(self, oracle: PatchOracle, scenes: Scenes, *, window: int, translation: float) -> None:
        self._oracle, self._scenes, self._window, self._translation = oracle, scenes, window, translation
        self._seen = (scenes.visible >= SEEN).nonzero().squeeze(1)
        self._reach = scenes.reach(oracle.threat.budget)
        self._size = min(window, scenes.size[0]), min(window, scenes.size[1])
        if any(side % oracle.stride for side in self._size):
            fitting = max(min(self._size) // oracle.stride, 1) * oracle.stride
            raise UserError(
                f"attack.window={window}: the sides of a picture must be multiples of {oracle.stride} for this detector, "
                f"for instance {fitting}"
            )

    def draw(self, number: int) -> None:
        """Draw the frames and the places of the windows."""
        generator, scenes = self._oracle.generator, self._scenes
        self._frames = self._seen[torch.randint(len(self._seen), (number,), generator=generator)]
        self._corners = corners(scenes.boxes[self._frames], scenes.size, self._window, self._translation, generator)

    def shown(self, patches: Tensor) -> Tensor:
        """Windows [N, 3, h, w] with patches [N, 3, P, P], or with the same patch [1, 3, P, P] in all."""
        return self._scenes.windows(self._frames, patches, self._oracle.threat.budget, self._corners, self._size)

    @property
    def boxes(self) -> Tensor:
        """[N, 4] the sign's boxes in the windows."""
        return self._scenes.boxes[self._frames] - self._corners.repeat(1, 2)

    @property
    def reach(self) -> Tensor:
        """[N, 4] boxes around all pixels that a patch changes."""
        return self._reach[self._frames] - self._corners.repeat(1, 2)

    def highest(self, predictions: Predictions) -> Tensor:
        """[N] the highest score of the sign in each view."""
        return predictions.scores_of(self._oracle.label).amax(-1)

    def reported(self, highest: Tensor) -> Tensor:
        """[N] what the detector reports of these scores (`reported`)."""
        return reported(self._oracle, highest, self._scenes.distance[self._frames])


def corners(
    boxes: Tensor, picture: tuple[int, int], window: int, translation: float, generator: torch.Generator
) -> Tensor:
    """int64 [N, 2] column and row of the first pixel of windows around signs [N, 4], shifted by a share of their side."""
    limit = torch.tensor([picture[1], picture[0]])
    side = limit.clamp(max=window)
    shift = (torch.rand(len(boxes), 2, generator=generator) * 2 - 1) * translation * window
    middle = (boxes[:, :2] + boxes[:, 2:]) / 2 + shift
    return torch.minimum((middle - side / 2).round().long().clamp(min=0), limit - side)


def reported(oracle: PatchOracle, scores: Tensor, distance: Tensor) -> Tensor:
    """[N] what the detector reports of scores [N] of views with the same patch, as if they were an approach, farthest first."""
    order = distance.argsort(descending=True)
    return oracle.aggregate(scores[order])[order.argsort()]
