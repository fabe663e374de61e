"""The ranking metric of the driving track, `safe_progress`."""

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

    Progress is Eq. 4.1 of the thesis without its offset, divided by 0.5, in [0, 1] per step. The mean is always over
    `max_steps`, also for shorter episodes.

    Args:
        progress: [B] sum over the episode's steps.
        failed: bool [B], whether the episode crashed or left the road.
        max_steps: length of an episode that is not terminated early.
    """
    if isinstance(progress, Tensor) and isinstance(failed, Tensor):
        return torch.where(failed, 0.0, progress / max_steps)
    return np.where(failed, 0.0, progress / max_steps)
