"""A lower bound of a mean score under every attack, for victims that add Gaussian noise to all that they see."""

from __future__ import annotations

import math
from statistics import NormalDist

from cavbench.statistics.estimates import Interval


def certificate(clean: Interval, shift: float) -> float:
    """The lowest mean score that any attack of a given size can leave (Kumar, Levine and Feizi 2022, arXiv 2106.11420).

    An attack changes the observations of an episode by at most `shift` standard deviations of the noise, in the L2 norm over all
    frames; it may see the noise of the frames before. Theorem 1 of the paper bounds how far that lowers the probability p of an
    event: to Phi(Phi^-1(p) - shift). A score S in [0, 1] is the probability of an event that is drawn with probability S, so the
    theorem holds for its mean. (The bound over the whole distribution of S, which the paper uses, is tighter; it needs more
    episodes than a cell has.)

    Args:
        clean: the mean score without an attack, in [0, 1], with its interval. The lower end counts.
        shift: in standard deviations, at least 0; inf for an attack that changes more than observations.

    Returns:
        In [0, 1]. As `clean.low` is exceeded with 97.5 % confidence, so is this.
    """
    if not clean.low > 0 or math.isinf(shift):
        return 0.0
    normal = NormalDist()
    return 1.0 if clean.low >= 1 else normal.cdf(normal.inv_cdf(clean.low) - shift)
