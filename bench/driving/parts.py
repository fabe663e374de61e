"""Units that are driven together: which episodes of a step belong to which, and whose random numbers attack them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor


class Part(NamedTuple):
    """The episodes of one unit among those of a step, and the random generator of its attack."""

    rows: slice
    generator: torch.Generator


def parts_of(parts: Sequence[Part], rows: Tensor) -> Sequence[Part]:
    """The units of the episodes `rows`, int64 [R] in ascending order, without the units that have none of them."""
    if len(parts) == 1:
        return [Part(slice(0, len(rows)), parts[0].generator)]
    ends = torch.searchsorted(rows, torch.tensor([0, *(part.rows.stop for part in parts)])).tolist()
    found = [Part(slice(start, end), part.generator) for part, (start, end) in zip(parts, pairwise(ends), strict=True)]
    return [part for part in found if part.rows.stop > part.rows.start]
