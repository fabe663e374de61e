"""Random generators that results must not depend on."""

from __future__ import annotations

import random

import numpy as np


def stir_others(seed: int) -> None:
    """Seed the global generators of NumPy and Python, which no run seeds."""
    np.random.seed(seed)  # noqa: NPY002
    random.seed(seed)
