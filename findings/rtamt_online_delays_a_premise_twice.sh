#!/usr/bin/env bash
# One guesses: rtamt's online monitor of "whenever another car cuts in, this one brakes within 2 s" gives the offline robustness, 2 s later, as its
# manual says. `cut_in -> brakes`, `no cut_in or brakes` and `not cut_in or brakes` are one rule.
# What happens: pastify() delays the variable of the comparison and the comparison. So the premise is 4 s old, and the answer is looked for
# between 2 and 4 s after it: braking at once is a violation, braking too late is none. Only the spelling with `not` is right. A rule that
# begins with `gap <= 2` is violated in the first seconds of each run, as the delayed gap is -inf.
# For whom it matters: a runtime monitor blames the driver that reacts, and clears the one that an attack makes late.
# Versions: rtamt 0.4.10 (pastifier/stl/pastifier.py, visitPredicate and visitVariable: each adds once[2,2]). Source: a guess that online and
# offline agree; the rule has the form of the manual's first example.
source "$(dirname "$0")/fresh.sh"
fresh rtamt==0.4.10
see <<'P'
import logging
from importlib.metadata import version

import rtamt

logging.disable()
WITHIN, STEPS, CUT_IN_AT = 2, 14, 3
BRAKES = "(eventually[0,2](braking >= 1))"
RULES = {"->": f"(cut_in >= 1) -> {BRAKES}", "or": f"(cut_in < 1) or {BRAKES}", "not or": f"(not(cut_in >= 1)) or {BRAKES}"}


def made(rule):
    specification = rtamt.StlDiscreteTimeSpecification()
    for name in ("cut_in", "gap", "braking"):
        specification.declare_var(name, "float")
    specification.spec = rule
    specification.parse()
    return specification


def lowest(rule, brakes_at):
    """The lowest robustness offline, and online after the delay, over all times that both decide."""
    read = {
        "cut_in": [2.0 if step == CUT_IN_AT else 0.0 for step in range(STEPS)],
        "gap": [9.0] * STEPS,
        "braking": [2.0 if step == brakes_at else 0.0 for step in range(STEPS)],
    }
    offline = [value for _, value in made(rule).evaluate({"time": list(range(STEPS)), **read})]
    monitor = made(rule)
    monitor.pastify()
    online = [monitor.update(step, [(name, values[step]) for name, values in read.items()]) for step in range(STEPS)]
    return min(offline[: STEPS - WITHIN]), min(online[WITHIN:])


seen = {name: {brakes_at - CUT_IN_AT: lowest(rule, brakes_at) for brakes_at in range(3, 9)} for name, rule in RULES.items()}
never_short = lowest(f"(gap <= 2) -> {BRAKES}", 4)
print(f"rtamt {version('rtamt')}: lowest robustness (offline, online) of braking within {WITHIN} s, by the seconds that it took: {seen}; "
      f"of a rule for gaps below 2, where all gaps are 9: {never_short}")
raise SystemExit(
    any(seen[name] != {0: (1, -1), 1: (1, -1), 2: (1, 1), 3: (-1, 1), 4: (-1, 1), 5: (-1, -1)} for name in ("->", "or"))
    or seen["not or"] != {seconds: (one, one) for seconds, one in enumerate((1, 1, 1, -1, -1, -1))}
    or never_short != (7, -1)
)
P
