"""Probes whether a victim is stochastic and whether it ignores its input; the leaderboard's flags use the results.

At some steps a probe evaluates the victim twice on the same observation, and once on the observation of another episode. It
does not count as a query of the attack, and it restores torch's global random generator.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bench.driving.policy import Policy, State

EVERY = 15
"""Steps between two probes: a second of driving."""
SAME = 1e-6
"""Two scores count as the same answer if they differ by at most this."""


class Probe:
    """Counts over a batch of B episodes."""

    def __init__(self, batch: int, policy: Policy) -> None:
        self.policy = policy
        self.redrawn, self.same, self.probed = (np.zeros(batch) for _ in range(3))
        self.draws, self.drawn = np.zeros(batch), np.zeros(batch)

    @torch.no_grad()
    def look(self, observation: Tensor, running: Tensor, state: State) -> bool:
        """Probe the running episodes of a step; return whether any answer changed on the second evaluation.

        Args:
            observation: the true observation, [B, V, F].
            running: bool [B].
            state: the policy's state.
        """
        rows = running.nonzero().squeeze(-1)
        if len(rows) < 2:
            return False
        others = observation.clone()
        others[rows] = observation[rows].roll(len(rows) // 2, 0)
        with torch.random.fork_rng(devices=[]):
            inputs = (observation, observation, others)
            first, again, other = (self.policy.scores(probe, state)[rows] for probe in inputs)
        redrawn = (first != again).flatten(1).any(1)
        same = ((first - other).abs() <= SAME).flatten(1).all(1)
        places = rows.numpy()
        self.probed[places] += 1
        self.redrawn[places] += redrawn.numpy()
        self.same[places] += same.numpy()
        return bool(redrawn.any())

    def count_draws(self, asked: Sequence[tuple[Tensor | None, Tensor]], running: Tensor) -> None:
        """Count how often an attack queried each distinct observation in a step.

        Args:
            asked: the attack's queries: the episodes, by index among the running ones (None: all), and the observations
                [..., B, V, F].
            running: bool [B].
        """
        places = running.nonzero().squeeze(-1)
        keys = [_keys(rows, observation) for rows, observation in asked]
        if not keys:
            return
        all_keys = torch.cat(keys)
        asked_of = torch.bincount(all_keys[:, 0].long(), minlength=len(places))
        distinct = torch.bincount(all_keys.unique(dim=0)[:, 0].long(), minlength=len(places))
        queried = places[asked_of > 0].numpy()
        self.draws[queried] += (asked_of / distinct.clamp(min=1))[asked_of > 0].numpy()
        self.drawn[queried] += 1

    def columns(self) -> Mapping[str, NDArray[np.float64]]:
        """`redrawn` and `same_answer`, shares of the probes, and `draws`, queries per observation; [B], NaN if not measured."""
        with np.errstate(invalid="ignore"):
            return {
                "redrawn": self.redrawn / self.probed,
                "same_answer": self.same / self.probed,
                "draws": self.draws / self.drawn,
            }


def _keys(rows: Tensor | None, observation: Tensor) -> Tensor:
    """[N, 2] for each query: the episode, and a number that identifies the observation."""
    flat = observation.flatten(-2).double()
    code = flat @ torch.linspace(1, 2, flat.shape[-1], dtype=torch.float64).sin()
    episode = torch.arange(flat.shape[-2]) if rows is None else rows
    return torch.stack((episode.double().expand(code.shape), code), -1).flatten(0, -2)
