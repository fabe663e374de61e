#!/usr/bin/env bash
# One guesses: the smallest counterexample of `x <= 0.3` for floats in [0, 1] is near 0.3 or small; that of an array has one such element.
# What happens: 1.0, the corner of the range, and an array of ones: floats shrink to whole numbers first, and to short binary fractions then.
# So a counterexample does not tell where a property begins to fail, and every test on [0, 1] is shown the corner.
# Versions: hypothesis 6.170.17, numpy 2.4.6. Source: a property that failed above a threshold and was reported at the end of the range.
source "$(dirname "$0")/fresh.sh"
fresh hypothesis==6.170.17 numpy==2.4.6
see <<'P'
import hypothesis
import numpy as np
from hypothesis import find, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

calm = settings(max_examples=2000, database=None, derandomize=True)
unit = st.floats(0, 1)
found = {
    "above 0.3": find(unit, lambda x: x > 0.3, settings=calm),
    "of [0.2, 0.4]": find(st.floats(0.2, 0.4), lambda x: True, settings=calm),
    "two of five above 0.5": find(arrays(np.float64, 5, elements=unit), lambda x: (x > 0.5).sum() >= 2, settings=calm).tolist(),
}
print(f"hypothesis {hypothesis.__version__}: smallest {found}")
raise SystemExit(found != {"above 0.3": 1.0, "of [0.2, 0.4]": 0.25, "two of five above 0.5": [1.0] * 5})
P
