#!/usr/bin/env bash
# One guesses: McNemar's test of two policies that crash in exactly the same episodes has p = 1, or no answer (0 / 0).
# What happens: with the correction for continuity, the default of the chi-squared test in statsmodels and mlxtend, 1 is taken off the
# difference of 0 and squared. The statistic is infinite and p is 0. One episode that differs makes it 1. The exact test says 1 for both.
# For whom it matters: an attack without any effect, or a policy beside its own copy, is the most significant row of a table.
# Versions: statsmodels 0.15.0 (stats/contingency_tables.py, mcnemar), mlxtend 0.25.0 (evaluate/mcnemar.py, mcnemar), scipy 1.17.1.
# pingouin 0.7.0 raises. Source: tables of paired crashes in three libraries, by all their tests.
source "$(dirname "$0")/fresh.sh"
fresh statsmodels==0.15.0 mlxtend==0.25.0 scipy==1.17.1 numpy
see <<'P'
from importlib.metadata import version

import numpy as np
from mlxtend.evaluate import mcnemar, mcnemar_table
from statsmodels.stats.contingency_tables import mcnemar as of_statsmodels

SCENARIOS = np.arange(200)


def p_values(first, second):
    """p of each test for crashes of two policies in the same episodes."""
    table = mcnemar_table(y_target=np.zeros(len(first), int), y_model1=first, y_model2=second)
    return {
        "statsmodels": float(of_statsmodels(table, exact=False).pvalue),
        "mlxtend": float(mcnemar(table)[1]),
        "statsmodels without correction": float(of_statsmodels(table, exact=False, correction=False).pvalue),
        "both, exact": {float(of_statsmodels(table, exact=True).pvalue), float(mcnemar(table, exact=True)[1])},
    }


crashes = (SCENARIOS % 4 == 0).astype(int)
one_more = crashes | (SCENARIOS == 1)
seen = {"the same 50 of 200 episodes": p_values(crashes, crashes), "one more episode": p_values(crashes, one_more)}
print(f"statsmodels {version('statsmodels')}, mlxtend {version('mlxtend')}: p where two policies crash in {seen}")
equal, other = seen.values()
raise SystemExit(
    [equal["statsmodels"], equal["mlxtend"], equal["both, exact"]] != [0.0, 0.0, {1.0}]
    or not np.isnan(equal["statsmodels without correction"])
    or [other["statsmodels"], other["mlxtend"], other["both, exact"]] != [1.0, 1.0, {1.0}]
)
P
