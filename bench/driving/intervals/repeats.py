"""Observations that stand in a batch more than once: what is a function of them is computed once.

A rehearsal asks under several lies at once. Where no car is in the lane that two of them differ in, they are the same.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavbench.compiled import entry_point, inner
from cavbench.driving.intervals.boxes import flat

Words = NDArray[np.int32]
Places = NDArray[np.int64]


class Distinct(NamedTuple):
    """What is known about U observations, each of which stands in a batch of N at least once.

    Args:
        observation: [U, V, F].
        tracks: [U, V - 1, 2 F - 1]; None if there are none.
        ego: [U, 7].
        place: int64 [N], which of them each one of the batch is.
    """

    observation: Tensor
    tracks: Tensor | None
    ego: Tensor
    place: Tensor


def answered(
    answer: Callable[[Tensor, Tensor | None, Tensor], Tensor], observation: Tensor, tracks: Tensor | None, ego: Tensor
) -> Tensor:
    """The answers [..., A] about observations [..., V, F] with their tracks and egos; those that repeat are asked about once."""
    one = distinct(observation, tracks, ego)
    if one is None:
        return answer(observation, tracks, ego)
    found = answer(one.observation, one.tracks, one.ego)
    return found[one.place].view(*observation.shape[:-2], found.shape[-1])


def distinct(observation: Tensor, tracks: Tensor | None, ego: Tensor) -> Distinct | None:
    """The distinct ones of observations [..., V, F] with their tracks and egos; None if all are."""
    shown, egos = flat(observation, 2), flat(ego, 1)
    if (count := len(shown)) < 2:
        return None
    moved = np.empty((count, 0), np.float32) if tracks is None else flat(tracks, 2).reshape(count, -1)
    first, place = np.empty(count, np.int64), np.empty(count, np.int64)
    found = find(_words(shown.reshape(count, -1)), _words(egos), _words(moved), first, place)
    if found == count:
        return None
    rows = first[:found]
    ones = None if tracks is None else torch.from_numpy(flat(tracks, 2)[rows])
    return Distinct(torch.from_numpy(shown[rows]), ones, torch.from_numpy(egos[rows]), torch.from_numpy(place))


def _words(values: NDArray[Any]) -> Words:
    """The bits of float32 numbers: -0 is not 0, and a NaN is itself."""
    return values.view(np.int32)


@inner
def _same(values: Words, one: int, other: int) -> bool:
    k = 0
    while k < values.shape[1] and values[one, k] == values[other, k]:
        k += 1
    return k == values.shape[1]


@entry_point
def find(shown: Words, egos: Words, tracks: Words, first: Places, place: Places) -> int:
    """How many distinct rows N have; fills their places in the batch, `first`, and which of them each row is, `place`.

    Args:
        shown, egos, tracks: the bits of what a row is, [N, n] each. Only those of `shown` are hashed (FNV-1a).
        first, place: [N].
    """
    count, size = 0, 2
    while size < 2 * len(shown):
        size *= 2
    table = np.full(size, -1, np.int64)
    for n in range(len(shown)):
        code = np.uint64(14695981039346656037)
        for k in range(shown.shape[1]):
            code = (code ^ np.uint64(np.uint32(shown[n, k]))) * np.uint64(1099511628211)
        at = np.int64((code ^ (code >> np.uint64(32))) & np.uint64(size - 1))
        while table[at] >= 0:
            other = first[table[at]]
            if _same(shown, n, other) and _same(egos, n, other) and _same(tracks, n, other):
                break
            at = (at + 1) % size
        if table[at] < 0:
            table[at], first[count], count = count, n, count + 1
        place[n] = table[at]
    return count
