"""Smoothing over time: the victim receives the mean or the median of the last observations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from annotated_types import Ge
from tensordict import TensorDict
from torch import Tensor

from cavbench.driving import ObservationFilter, State

Reduction = Literal["mean", "median"]


@dataclass(frozen=True, kw_only=True)
class FrameStack(ObservationFilter):
    """The victim receives the mean or the median of the last k observations.

    This removes perturbations that change from frame to frame, but not constant ones. The result is delayed: by (k - 1) / 2
    frames with the mean. Rows are ordered by distance, so when two cars change order their rows are mixed for k - 1 frames.

    Args:
        frames: k, number of observations; before the k-th step, earlier ones are copies of the first.
        reduce: `mean` or `median` of each feature, over the frames in which the row is present.
    """

    differentiable = True

    frames: Annotated[int, Ge(2)] = 4
    reduce: Reduction = "mean"

    def step(self, observation: Tensor, memory: State) -> tuple[Tensor, State]:
        newest = observation.unsqueeze(-3)
        if memory is None:
            shown, stack = observation, newest.expand(*newest.shape[:-3], self.frames, *newest.shape[-2:])
        else:
            stack = torch.cat((memory["stack"], newest), -3)
            shown = self._reduced(stack)
        return shown, TensorDict({"stack": stack[..., 1:, :, :]}, batch_size=observation.shape[:-2])

    def _reduced(self, stack: Tensor) -> Tensor:
        """[..., V, F] the newest presence; each measured feature reduced over the frames in which its row is present."""
        presence = stack[..., -1, :, :1]
        measured = torch.where(stack[..., :1] > 0, stack[..., 1:], torch.nan)
        reduced = measured.nanmean(-3) if self.reduce == "mean" else _median(measured)
        return torch.cat((presence, torch.where(presence > 0, reduced, 0.0)), -1)


def _median(measured: Tensor) -> Tensor:
    """The median [..., V, F - 1] over frames, ignoring NaN; for an even number, the mean of the two middle values."""
    return (measured.nanmedian(-3).values - (-measured).nanmedian(-3).values) / 2
