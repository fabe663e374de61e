#!/usr/bin/env bash
# One guesses: where half of the episodes crash, the median time to a crash is that of the last of these crashes, or there is none. Libraries may
# differ, but one library has one rule.
# What happens: lifelines asks whether the curve is at most 0.5, statsmodels whether it is below. But both sum up the curve in floats, and 0.5
# may be the number above or below. So 5 crashes of 10 have the median 5, and each episode taken twice has the median infinity. In
# statsmodels 16 of 100 such studies have a median, and the others have none. Other shares do the same.
# For whom it matters: an attack that crashes half of the episodes has a median time to a crash, or is said never to reach it, by their number.
# Versions: lifelines 0.30.3 (fitters/kaplan_meier_fitter.py, the curve; utils/__init__.py, qth_survival_time), statsmodels 0.15.0
# (duration/survfunc.py, SurvfuncRight.quantile). Source: one set of episodes, taken once to ten times, in two libraries.
source "$(dirname "$0")/fresh.sh"
fresh lifelines==0.30.3 statsmodels==0.15.0 numpy
see <<'P'
import math
from importlib.metadata import version

import numpy as np
from lifelines import KaplanMeierFitter
from statsmodels.duration.survfunc import SurvfuncRight

HORIZON = 40.0


def medians(times, share=0.5):
    """Time until which `share` of the episodes crash: by lifelines and by statsmodels. At HORIZON an episode ends without a crash."""
    crashed = times < HORIZON
    fitted = KaplanMeierFitter().fit(times, crashed)
    return float(fitted.percentile(1 - share)), float(SurvfuncRight(times, crashed.astype(int)).quantile(share))


def episodes(crashes, of):
    return np.r_[np.linspace(1, 5, crashes), np.full(of - crashes, HORIZON)]


repeated = {times: medians(np.repeat(episodes(5, 10), times)) for times in range(1, 11)}
half = {of: medians(episodes(of // 2, of)) for of in range(2, 202, 2)}
more = {of: medians(episodes(of // 2 + 1, of)) for of in range(2, 202, 2)}
thirds = {of: medians(episodes(3 * of // 10, of), 0.3) for of in range(10, 210, 10)}
found = {name: (len(one), *(sum(map(math.isfinite, column)) for column in zip(*one.values())))
         for name, one in {"half crash": half, "one more": more, "3 of 10, the 30 % quantile": thirds}.items()}
print(f"lifelines {version('lifelines')}, statsmodels {version('statsmodels')}: (median of lifelines, of statsmodels) of 5 crashes of 10, each episode "
      f"taken once, twice, ...: {list(repeated.values())}; (numbers of episodes from 2 to 200, those with a time by lifelines, by statsmodels): {found}")
cases, by_lifelines, by_statsmodels = found["half crash"]
raise SystemExit(
    not 0 < by_lifelines < cases
    or not 0 < by_statsmodels < cases
    or len({first for first, _ in repeated.values()}) != 2
    or found["one more"] != (cases, cases, cases)
)
P
