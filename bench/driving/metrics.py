"""What an episode of driving is worth: the ranking metric."""

from __future__ import annotations

from typing import Any, overload

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


@overload
def safe_progress(progress: Tensor, failed: Tensor, max_steps: int) -> Tensor: ...
@overload
def safe_progress(progress: NDArray[Any], failed: NDArray[np.bool_], max_steps: int) -> NDArray[Any]: ...
def safe_progress(
    progress: Tensor | NDArray[Any], failed: Tensor | NDArray[np.bool_], max_steps: int
) -> Tensor | NDArray[Any]:
    """The ranking metric [B] in [0, 1]: 0 for an episode that crashes or leaves the road, else its mean progress.

    Progress is Eq. 4.1 of the thesis without its offset, over 0.5, in [0, 1] a step; the mean is over `max_steps`, whatever the
    episode's length.

    Args:
        progress: [B] sum over the episode's steps.
        failed: bool [B] whether it crashed or left the road.
        max_steps: of an episode that runs to its end.
    """
    if isinstance(progress, Tensor) and isinstance(failed, Tensor):
        return torch.where(failed, 0.0, progress / max_steps)
    return np.where(failed, 0.0, progress / max_steps)
