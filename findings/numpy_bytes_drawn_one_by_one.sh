#!/usr/bin/env bash
# One guesses: rng.integers(0, 256, 8, dtype="uint8") are the numbers of eight single draws, as for int64, and as for normal numbers.
# What happens: for uint8, uint16 and bool a call takes several numbers out of one word of the generator, and throws the rest away at its
# end. Frames of random bytes that are drawn in a batch are other ones than those that are drawn one by one.
# Versions: numpy 2.4.6. Source: a comparison of all types of integers.
source "$(dirname "$0")/fresh.sh"
fresh numpy==2.4.6
see <<'P'
import numpy as np


def equal(draw):
    """Whether eight numbers at once are eight numbers one by one."""
    batch, single = np.random.default_rng(0), np.random.default_rng(0)
    return np.array_equal(draw(batch, 8), [draw(single, None) for _ in range(8)])


TYPES = "uint8", "uint16", "bool", "uint32", "int64"
seen = {kind: equal(lambda rng, size: rng.integers(0, 2, size, dtype=kind)) for kind in TYPES}
seen["normal"] = equal(lambda rng, size: rng.standard_normal(size))
print(f"numpy {np.__version__}: a batch has the numbers of single draws: {seen}")
raise SystemExit(list(seen.values()) != [False, False, False, True, True, True])
P
