"""How often sequential intervals hold the truth in simulated studies that stop when the interval is narrow:

    python -m tests.statistics.simulated_stops [STUDIES]

Each study draws scenario after scenario, looks after every ten, and stops if the interval is narrow or 100 scenarios are driven.
`always` is the share of studies in which the interval held the truth at every look; `at the stop` that of the interval that is
printed; `ordinary` that of Student's interval at the same stop, which is made for a fixed number of scenarios.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cavbench.run.plan import SCENARIOS
from cavbench.statistics.estimates import Array, t_quantile
from cavbench.statistics.sequential import confidence_sequence

MOST = 100
PART = 100
Draw = Callable[[np.random.Generator, tuple[int, int]], Array]
# The standard deviations are those of means over 18 cells and the training seeds, from the published records.
SCORES: dict[str, tuple[float, Draw]] = {
    "dqn + advtrain: mean .31, sd .08": (0.31, lambda rng, shape: _beta(rng, shape, 0.31, 0.08)),
    "dqn, clean: mean .77, sd .05": (0.77, lambda rng, shape: _beta(rng, shape, 0.77, 0.05)),
    "dqn: mean .01, sd .02": (0.01, lambda rng, shape: _beta(rng, shape, 0.01, 0.02)),
    "one cell: mean .31, sd .35": (0.31, lambda rng, shape: _beta(rng, shape, 0.31, 0.35)),
    "a flag: 0 or 1, mean .05": (0.05, lambda rng, shape: (rng.random(shape) < 0.05).astype(float)),
    "a flag: 0 or 1, mean .5": (0.5, lambda rng, shape: (rng.random(shape) < 0.5).astype(float)),
}


@dataclass(frozen=True)
class Studied:
    """Shares of studies, the mean number of scenarios, and the mean half width at the stop."""

    always: float
    at_stop: float
    ordinary: float
    scenarios: float
    width: float


def _beta(rng: np.random.Generator, shape: tuple[int, int], mean: float, deviation: float) -> Array:
    total = mean * (1 - mean) / deviation**2 - 1
    return rng.beta(mean * total, (1 - mean) * total, shape)


def studied(name: str, until: float, studies: int, seed: int = 0) -> Studied:
    """Simulate studies of one kind of score."""
    truth, draw = SCORES[name]
    rng = np.random.default_rng(seed)
    parts = [_part(draw(rng, (PART, MOST)), truth, until) for _ in range(max(1, studies // PART))]
    return Studied(*np.concatenate(parts, 1).mean(1).tolist())


def _part(scores: Array, truth: float, until: float) -> Array:
    """[5, studies]: the fields of `Studied`."""
    low, high = (bound[:, SCENARIOS - 1 :: SCENARIOS] for bound in confidence_sequence(scores, width=until, most=MOST))
    narrow = high - low <= 2 * until
    stop = np.where(narrow.any(1), narrow.argmax(1), narrow.shape[1] - 1)
    holds = (low <= truth) & (truth <= high)
    rows = np.arange(len(scores))
    counts = (stop + 1) * SCENARIOS
    upto = np.arange(MOST) < counts[:, None]
    means = (scores * upto).sum(1) / counts
    deviations = np.sqrt((np.square(scores - means[:, None]) * upto).sum(1) / (counts - 1))
    ordinary = np.abs(means - truth) <= t_quantile(counts - 1.0) * deviations / np.sqrt(counts)
    return np.stack([holds.all(1), holds[rows, stop], ordinary, counts, (high - low)[rows, stop] / 2]).astype(float)


def main() -> None:
    """Print the table of studies/stop_coverage.md."""
    studies = int(sys.argv[1]) if len(sys.argv) > 1 else 2000
    lines = [
        "| scores of scenarios | until | always | at the stop | ordinary | scenarios | ± at the stop |",
        "|---|---|---|---|---|---|---|",
    ]
    for name in SCORES:
        for until in (0.05, 0.02):
            found = studied(name, until, studies)
            shares = " | ".join(f"{100 * share:.1f} %" for share in (found.always, found.at_stop, found.ordinary))
            lines.append(f"| {name} | {until:g} | {shares} | {found.scenarios:.0f} | {found.width:.3f} |")
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
