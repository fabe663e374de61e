#!/usr/bin/env bash
# One guesses: the robustness of "the gap stays above 2 m" over a trace with one lost sample (NaN) is NaN, or that of the other samples.
# What happens: by place and by operator the NaN hides a violation. rtamt's `always` without an end forgets what comes after the NaN, its
# `historically` what came before. With an end it does not. In dense time it does. mstlo says robustness 5 where its own verdict is False.
# For whom it matters: a sensor that an attack blinds for one step makes a run that crashes robust, by +5 instead of -3.
# Versions: rtamt 0.4.10 (semantics/stl/discrete_time/offline/ast_visitor.py, visitAlways; online/historically_operation.py, update: min() of
# Python keeps its first argument), mstlo-python 0.2.2 (Monitor). Source: one trace in two libraries, by all their semantics.
source "$(dirname "$0")/fresh.sh"
fresh rtamt==0.4.10 mstlo-python==0.2.2
see <<'P'
import logging
from importlib.metadata import version

import mstlo_python as mstlo
import rtamt

logging.disable()
NAN = float("nan")
AFTER, BEFORE, WHOLE = [7.0, NAN, -1.0, 6.0], [7.0, -1.0, NAN, 6.0], [7.0, -1.0, -1.0, 6.0]


def specification(kind, formula):
    made = kind()
    made.declare_var("gap", "float")
    made.spec = formula
    made.parse()
    return made


def discrete(formula, gaps):
    return specification(rtamt.StlDiscreteTimeSpecification, formula).evaluate({"time": [0, 1, 2, 3], "gap": gaps})[0][1]


def dense(formula, gaps):
    samples = [[float(time), gap] for time, gap in enumerate(gaps)]
    return specification(rtamt.StlDenseTimeSpecification, formula).evaluate(["gap", samples])[0][1]


def online(formula, gaps):
    monitor = specification(rtamt.StlDiscreteTimeSpecification, formula)
    return [monitor.update(time, [("gap", gap)]) for time, gap in enumerate(gaps)][-1]


def told(semantics, gaps):
    monitor = mstlo.Monitor(mstlo.parse_formula("G[0, 3](gap >= 2)"), semantics=semantics)
    return [value for time, gap in enumerate(gaps) for at, value in monitor.update("gap", gap, float(time)).verdicts() if at == 0][-1]


seen = {
    name: {
        "always": discrete("always(gap >= 2)", gaps),
        "always[0,3]": discrete("always[0,3](gap >= 2)", gaps),
        "dense always[0,3]": dense("always[0,3](gap >= 2)", gaps),
        "historically": online("historically(gap >= 2)", gaps),
        "historically[0,3]": online("historically[0,3](gap >= 2)", gaps),
        "mstlo quantitative": told("DelayedQuantitative", gaps),
        "mstlo qualitative": told("DelayedQualitative", gaps),
        "mstlo intervals": told("Rosi", gaps)[0],
    }
    for name, gaps in {"no NaN": WHOLE, "NaN before the violation": AFTER, "NaN after it": BEFORE}.items()
}
print(f"rtamt {version('rtamt')}, mstlo {version('mstlo-python')}: robustness of gap >= 2 for gaps of 7, 6 and -1: {seen}")
right = {name: False if name.endswith("qualitative") else -3.0 for name in seen["no NaN"]}
raise SystemExit(
    seen["no NaN"] != right
    or seen["NaN before the violation"] != right | {"always": 5.0, "dense always[0,3]": 5.0, "mstlo quantitative": 5.0}
    or seen["NaN after it"] != right | {"historically": 4.0}
)
P
