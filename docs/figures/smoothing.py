"""Noise on what a driver sees: what it costs, and what it certifies."""

from __future__ import annotations

from functools import cache

import numpy as np
from matplotlib.figure import Figure

from cavbench.driving import ObservationThreat
from cavbench.statistics.certificate import certificate
from cavbench.statistics.estimates import share_interval
from docs.figures import style
from docs.figures.driving import FACTS, FEATURES, Array, scored

SIGMAS = (0.005, 0.01, 0.02, 0.05)
COLOURS = (style.GREY, style.BLUE, style.GREEN, style.ORANGE)
EPISODES, ROWS = 20, 10
BUDGETS = np.geomspace(1e-5, 3e-3, 60)


def smoothing() -> Figure:
    """The score by noise, with and without an attack, and the certified score by budget."""
    made = style.figure(4.0, "smoothing: a certificate for very small changes only")
    measured, certified = made.subplots(1, 2)
    for attack, colour in (("none", style.BLUE), ("pgd", style.RED)):
        means = [100 * _scores(attack, sigma).mean() for sigma in SIGMAS]
        measured.plot(SIGMAS, means, color=colour, marker="o", ms=4, label="no attack" if attack == "none" else attack)
    measured.set(xscale="log", xlabel="noise (normalised)", ylabel="safe progress, %", ylim=(-3, 103))
    measured.minorticks_off()
    measured.set_xticks(SIGMAS, [f"{sigma:g}" for sigma in SIGMAS])
    measured.set_title(f"dqn, budget 10 %, {EPISODES} scenarios", fontsize=10.5)
    measured.legend(loc="upper right", fontsize=9.5)
    for sigma, colour in zip(SIGMAS, COLOURS, strict=True):
        clean = share_interval(_scores("none", sigma)[None, None])
        bounds = [100 * certificate(clean, _reach(budget) / sigma) for budget in BUDGETS]
        certified.plot(100 * BUDGETS, bounds, color=colour, label=f"noise {sigma:g}")
    certified.set(xscale="log", xlabel="budget, %", ylabel="certified under every attack, %", ylim=(-3, 103))
    certified.legend(loc="upper right", fontsize=9.5)
    return made


def _reach(budget: float) -> float:
    return ObservationThreat(budget=budget).reach(ROWS, FEATURES, FACTS.max_steps)


@cache
def _scores(attack: str, sigma: float) -> Array:
    """[E] of the first scenarios of the standard grid on the road that is shown."""
    words = (f"attack={attack}", "victim=dqn", "defense=smoothing", f"defense.sigma={sigma}")
    return scored(EPISODES, *words).columns["safe_progress"].astype(np.float64)
