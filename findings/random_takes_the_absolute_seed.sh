#!/usr/bin/env bash
# One guesses: random.seed(-5) is another stream than random.seed(5).
# What happens: whole numbers are taken without their sign. Seeds that are made by hash(), or drawn from both sides of 0, meet.
# (numpy refuses negative seeds; torch takes -1 and 2**32 - 1 for one.)
# Versions: Python 3.11 to 3.13. Source: a comparison of seeds; the documentation says that an int is used directly.
source "$(dirname "$0")/fresh.sh"
fresh numpy==2.4.6
see <<'P'
import platform
import random

same = [random.Random(seed).random() == random.Random(-seed).random() for seed in (1, 5, 2**40)]
print(f"Python {platform.python_version()}: seeds s and -s give one stream: {same}")
raise SystemExit(not all(same))
P
