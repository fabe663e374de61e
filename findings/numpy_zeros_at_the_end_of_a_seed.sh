#!/usr/bin/env bash
# One guesses: default_rng([seed, worker]) gives each worker a stream of its own, and none that of default_rng(seed).
# What happens: worker 0 has that of default_rng(seed). Up to four words, zeros at the end count for nothing: default_rng([5, 0, 0, 0]) is
# default_rng(5). What a parent draws from its seed, its first worker draws again. SeedSequence(seed, spawn_key=(0,)) is another stream.
# Versions: numpy 2.4.6. Source: a comparison of lists of seeds.
source "$(dirname "$0")/fresh.sh"
fresh numpy==2.4.6
see <<'P'
import numpy as np

SEEDS = [5, 0], [5, 0, 0, 0], [5, 0, 0, 0, 0], [0, 5], [5, 1]
first = np.random.default_rng(5).random()
seen = {str(seed): bool(np.random.default_rng(seed).random() == first) for seed in SEEDS}
spawned = bool(np.random.default_rng(np.random.SeedSequence(5, spawn_key=(0,))).random() == first)
print(f"numpy {np.__version__}: the stream of default_rng(5): {seen}, spawn_key=(0,): {spawned}")
raise SystemExit(list(seen.values()) != [True, True, False, False, False] or spawned)
P
