"""Points of the perturbation set: random ones to start from, and the best one by a key (lower is better for the attacker)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from cavbench.driving import Oracle


def random_starts(observation: Tensor, restarts: int, oracle: Oracle) -> Tensor:
    """[R, B, V, F] random points of the perturbation set; all episodes of a unit share the random numbers."""
    shape = (restarts, 1, *observation.shape[1:])
    shares = [
        torch.rand(shape, generator=part.generator).expand(-1, part.rows.stop - part.rows.start, -1, -1)
        for part in oracle.parts
    ]
    return oracle.project(observation + (torch.cat(shares, 1) * 2 - 1) * oracle.radius)


def better(best: Tensor, lowest: Tensor, x: Tensor, key: Tensor) -> tuple[Tensor, Tensor]:
    """The better of two points of each restart and episode, [R, B, V, F], and its key [R, B]."""
    improved = key < lowest
    return torch.where(improved[..., None, None], x, best), torch.where(improved, key, lowest)


def best_of(points: Tensor, keys: Tensor, observation: Tensor, known: Tensor | None) -> Tensor:
    """[B, V, F] the point with the lowest key; the true observation if none is below its own.

    Args:
        points, keys: [R, B, V, F] and [R, B].
        observation: the true observation [B, V, F].
        known: its key [B]; None if it is no candidate.
    """
    least, start = keys.min(0)
    found = points[start, torch.arange(len(observation))]
    return found if known is None else torch.where((least < known)[:, None, None], found, observation)
