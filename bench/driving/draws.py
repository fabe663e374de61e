"""Random numbers of a victim that belong to an episode: what it draws does not depend on the batch that it is asked in.

The run gives each observation a number: a function of its episode and of how often the victim was asked about that episode
before. A policy that takes its noise from `noise` draws by these numbers. So units of a random victim can be driven in one
batch, with the records that each has alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import numpy as np
import torch
from torch import Tensor

from cavbench.driving import draw_kernels

_GIVEN: ContextVar[Tensor | None] = ContextVar("given", default=None)


class Draws:
    """Numbers for the draws of B episodes.

    Args:
        keys: int64 [B], a number of each episode that nobody else knows.
    """

    def __init__(self, keys: Tensor) -> None:
        self._keys = keys.numpy().astype(np.uint64)
        self._counts = np.zeros(len(keys), np.uint64)

    def numbers(self, rows: Tensor | None = None, copies: int = 1) -> Tensor:
        """New numbers, int64 [K * R], for K `copies` of all episodes or of `rows`, int64 [R], one copy after the other."""
        places = slice(None) if rows is None else rows.numpy()
        keys = self._keys[places]
        found = np.empty((copies, len(keys)), np.uint64)
        draw_kernels.numbered(keys, self._counts[places], copies, found)
        self._counts[places] += np.uint64(copies)
        return torch.from_numpy(found.view(np.int64)).flatten()


@contextmanager
def given(numbers: Tensor | None) -> Iterator[None]:
    """Ask a policy about N observations with a number for each, int64 [N]; None for the generator of the process."""
    if numbers is None:
        yield
        return
    token = _GIVEN.set(numbers)
    try:
        yield
    finally:
        _GIVEN.reset(token)


def noise(like: Tensor) -> Tensor:
    """Standard normal noise for the measured values of observations `like` [..., V, F]: [..., V, F - 1].

    It is a function of the numbers that the run gave these observations. Without a number for each, torch's generator draws.
    """
    numbers, leading, size = _GIVEN.get(), like.shape[:-2], like.shape[-2:]
    wanted = size[0] * (size[1] - 1)
    if numbers is None or len(numbers) != leading.numel():
        return torch.randn_like(like[..., 1:])
    values = np.empty((len(numbers), wanted + wanted % 2), np.float32)
    draw_kernels.normal(numbers.numpy().view(np.uint64), values)
    return torch.from_numpy(values)[:, :wanted].reshape(*leading, size[0], size[1] - 1).to(like)
