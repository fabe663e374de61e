"""Random numbers of a victim that belong to an episode: what it draws does not depend on the batch that it is asked in.

The run gives each observation a number: a function of its episode and of how often the victim was asked about that episode
before. A policy that takes its noise from `noise` draws by these numbers. So units of a random victim can be driven in one
batch, with the records that each has alone. Probes give numbers of their own: a victim cannot tell them from driving.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from cavbench.driving import draw_kernels

CALL, POINT, LARGEST = 0xD1342543DE82EF95, 0xAF251AF3B0F025B5, 2**64 - 1
"""What is added to the numbers for each further call of `noise` in an answer, and for each further point at which a filter asks
about an observation (multipliers of Steele and Vigna 2022)."""


@dataclass(eq=False)
class Given:
    """The numbers for an answer, int64 [N], and how often it has drawn by them."""

    numbers: Tensor
    calls: int = 0


_GIVEN: ContextVar[Given | None] = ContextVar("given", default=None)


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
        places = np.arange(len(self._keys)) if rows is None else rows.numpy()
        found = np.empty((copies, len(places)), np.uint64)
        draw_kernels.numbered(self._keys, self._counts, places, found)
        return torch.from_numpy(found.view(np.int64)).flatten()


def fresh(count: int, generator: torch.Generator) -> Tensor:
    """Numbers of no episode, int64 [N]."""
    return torch.randint(-(2**63), 2**63 - 1, (count,), generator=generator)


@contextmanager
def given(numbers: Tensor | None) -> Iterator[Given | None]:
    """Ask a policy about N observations with a number for each, int64 [N]; None for the generator of the process."""
    if numbers is None:
        yield None
        return
    found = Given(numbers)
    token = _GIVEN.set(found)
    try:
        yield found
    finally:
        _GIVEN.reset(token)


def noise(like: Tensor) -> Tensor:
    """Standard normal noise for the measured values of observations `like` [..., V, F]: [..., V, F - 1].

    It is a function of the numbers that the run gave these observations, and of how often this answer has drawn before. A filter
    may ask at several points about each observation: they stand in front, [P, N, V, F], and each has noise of its own. Without a
    number for each observation, torch's generator draws.
    """
    found, leading, size = _GIVEN.get(), like.shape[:-2], like.shape[-2:]
    wanted = size[0] * (size[1] - 1)
    points = None if found is None else _points(leading, len(found.numbers))
    if found is None or points is None:
        return torch.randn_like(like[..., 1:])
    numbers = found.numbers.numpy().view(np.uint64)
    if found.calls:
        numbers = numbers + np.uint64(found.calls * CALL & LARGEST)
    if points > 1:
        numbers = (np.arange(points, dtype=np.uint64)[:, None] * np.uint64(POINT) + numbers).reshape(-1)
    found.calls += 1
    values = np.empty((len(numbers), wanted + wanted % 2), np.float32)
    draw_kernels.normal(numbers, values)
    return torch.from_numpy(values)[:, :wanted].reshape(*leading, size[0], size[1] - 1).to(like)


def _points(leading: torch.Size, numbers: int) -> int | None:
    """How many points stand in front of the observations that have the numbers; None if these are other observations."""
    return next(
        (leading[:place].numel() for place in range(len(leading) + 1) if leading[place:].numel() == numbers), None
    )
