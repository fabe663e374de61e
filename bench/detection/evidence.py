"""Scores of a detector as log-odds, which keep a slope where it is sure."""

from __future__ import annotations

from torch import Tensor

SUREST = 1e-6
"""Scores closer to 0 or 1 than this have the log-odds of this."""


def log_odds(scores: Tensor) -> Tensor:
    """The log-odds log(p / (1 - p)) of scores in [0, 1], finite."""
    return scores.clamp(SUREST, 1 - SUREST).logit()
