#!/usr/bin/env bash
# One guesses: workers that are forked go on with the states of random and numpy.random, so all of them draw the same numbers.
# What happens: numpy's are the same in all workers. Python's random is seeded anew by the operating system in each fork: random.seed(0) before
# the fork is lost, and a run cannot be repeated. random.Random(0), an object, is copied as numpy's state is.
# Versions: Python 3.11 to 3.13, numpy 2.4.6. Source: draws of forked workers under one seed.
source "$(dirname "$0")/fresh.sh"
fresh numpy==2.4.6
see <<'P'
import multiprocessing
import platform
import random

import numpy as np

own = random.Random(0)


def drawn(_):
    return random.random(), own.random(), np.random.rand()


def run():
    random.seed(0)
    own.seed(0)
    np.random.seed(0)
    with multiprocessing.get_context("fork").Pool(2, maxtasksperchild=1) as pool:
        return list(zip(*pool.map(drawn, range(2), chunksize=1)))


first, second = run(), run()
seen = {name: (a[0] == a[1], a == b) for name, a, b in zip(("random", "random.Random", "numpy.random"), first, second)}
print(f"Python {platform.python_version()}: (both workers draw the same, both runs draw the same): {seen}")
raise SystemExit(list(seen.values()) != [(False, False), (True, True), (True, True)])
P
