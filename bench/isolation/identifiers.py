"""Opaque numbers that identify episodes to a victim without telling it the scenario."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, tensor

from cavbench.identity.fingerprint import digest


def opaque(seeds: Sequence[int], salt: object) -> Tensor:
    """int64 [B], a salted hash of each scenario seed, in [0, 2^60).

    The same salt and seed give the same number, so that a randomised policy is repeatable.
    """
    return tensor([int(digest(["episode", salt, seed])[:15], 16) for seed in seeds])
