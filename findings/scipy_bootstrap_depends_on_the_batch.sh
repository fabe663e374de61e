#!/usr/bin/env bash
# One guesses: `batch` of scipy.stats.bootstrap, "the number of resamples to process" at once, is for the memory. One seed has one interval.
# What happens: for two samples or more each batch draws for the first sample, then for the second. Another batch pairs other draws, and the
# interval is another one. One sample, paired samples and permutation_test do not depend on it.
# For whom it matters: a difference of two policies is significant on one machine, and is not on one with less memory, from one seed.
# Versions: scipy 1.17.1 (stats/_resampling.py, bootstrap). Source: one seed and batches from 1 to all, for each function of the module.
source "$(dirname "$0")/fresh.sh"
fresh scipy==1.17.1 numpy
see <<'P'
import numpy as np
import scipy
from scipy import stats

BATCHES = (None, 2000, 500, 100, 50)
# The smallest gap to a car ahead, in m, in 40 episodes of each of two policies. Their difference is about as large as its interval.
first, second = stats.norm.ppf((np.arange(40) + 0.5) / 40)[None] * 2 + np.array([[6.0], [6.875]])


def difference(x, y, axis=-1):
    return np.mean(y, axis=axis) - np.mean(x, axis=axis)


def intervals(data, statistic, seed, **options):
    """The 95 % interval for each batch, all from one seed."""
    made = [
        stats.bootstrap(data, statistic, n_resamples=2000, batch=batch, rng=np.random.default_rng(seed), method="percentile", **options)
        for batch in BATCHES
    ]
    return [tuple(round(float(end), 4) for end in one.confidence_interval) for one in made]


def p_values(seed):
    return {
        float(stats.permutation_test((first, second), difference, n_resamples=999, batch=batch, rng=np.random.default_rng(seed)).pvalue)
        for batch in BATCHES
    }


two = [intervals((first, second), difference, seed) for seed in range(20)]
counts = {
    "two samples": [len(set(one)) for one in two],
    "one sample": [len(set(intervals((first,), np.mean, seed))) for seed in range(3)],
    "two paired samples": [len(set(intervals((first, second), difference, seed, paired=True))) for seed in range(3)],
    "permutation test": [len(p_values(seed)) for seed in range(3)],
}
split = [one for one in two if len({low > 0 for low, _ in one}) == 2]
print(f"scipy {scipy.__version__}: how many intervals {len(BATCHES)} batches give from one seed: {counts}; seeds of 20 in which 0 is inside by "
      f"some and outside by others: {len(split)}, the first: {dict(zip(BATCHES, split[0])) if split else None}")
raise SystemExit({*counts["two samples"]} != {4} or len(split) < 10 or {*counts["one sample"], *counts["two paired samples"], *counts["permutation test"]} != {1})
P
