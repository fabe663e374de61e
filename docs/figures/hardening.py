"""Adversarial training: what is left of a victim under attack, hardened or not."""

from __future__ import annotations

import json

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.config import run_config
from bench.drive import drive
from bench.plan import plan
from bench.stopping import THRESHOLD
from docs.figures import style
from leaderboard.published import published

BUDGETS = (0.0, 0.025, 0.05, 0.1, 0.15, 0.2)
TRAINED_AT = 0.1
EPISODES = 20
ROAD = "lanes=5 density=1 weather=clear seeds=0 reference=false"


def advtrain() -> Figure:
    """Safe progress under both attacks as the budget grows, undefended and hardened."""
    made = style.figure(4.2, "advtrain: the hardened policy gives way later")
    axes = made.subplots(1, 2, sharey=True)
    for panel, attack in zip(axes, ("zo", "pgd"), strict=True):
        for defense, colour, marker, name in (
            ("none", style.UNDEFENDED, "o", "undefended"),
            ("advtrain", style.HARDENED, "s", "hardened"),
        ):
            kept = [100 * _safe_progress(attack, defense, budget) for budget in BUDGETS]
            panel.plot([100 * budget for budget in BUDGETS], kept, marker=marker, color=colour, lw=2.2, label=name)
        panel.axvline(100 * TRAINED_AT, color=style.GREY, lw=1, ls=":")
        panel.set(xlabel="budget (% of each value)", ylim=(-3, 103))
        panel.set_title(f"under {attack}", fontsize=11)
    axes[0].set_ylabel("safe progress, %")
    axes[1].legend(loc="upper right")
    axes[0].annotate("trained\nat", (100 * TRAINED_AT, 2), (3, 0), textcoords="offset points", fontsize=9.5)
    return made


def _safe_progress(attack: str, defense: str, budget: float) -> float:
    words = [*ROAD.split(), "victim=dqn", f"defense={defense}", f"episodes={EPISODES}"]
    words += [f"attack={attack}", f"threat.budget={budget}"] if budget else ["attack=none"]
    unit = next(unit for unit in plan(run_config(words)) if unit.pair.is_clean == (not budget))
    return float(drive(unit)["safe_progress"].mean())
