"""Random states that a result must not hang on."""

from __future__ import annotations

import random

import numpy as np


def stir_others(seed: int) -> None:
    """Set the generators that no run seeds: NumPy's and Python's."""
    np.random.seed(seed)  # noqa: NPY002
    random.seed(seed)
