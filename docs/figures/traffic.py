"""Driven traffic: the last seconds before a crash, from above."""

from __future__ import annotations

import numpy as np
import torch
from matplotlib.figure import Figure

from cavbench.driving.drive import drive
from cavbench.driving.rollout import Trace
from cavbench.run.config import plan_of
from docs.figures import road, style
from docs.figures.driving import FACTS, physical

OPTIONS = "attack=cut_in victim=planner defense=tracker threat.traffic.cars=1 lanes=3 density=2 weather=clear seeds=0"
EPISODES = 24
BEFORE_S = (2.0, 1.0, 0.5, 0.0)
REACH = (-15.0, 45.0)


def cut_in() -> Figure:
    """Four moments of the first episode that ends in a crash."""
    unit = next(iter(plan_of([*OPTIONS.split(), f"episodes={EPISODES}", "reference=false"]).units()))
    driven = drive(unit.job, unit.seeds)
    seed, trace = next(
        (seed, trace)
        for seed, trace in driven.traces.items()
        if isinstance(trace, Trace) and np.stack(trace.steps["crashed"]).any()
    )
    end = int(np.stack(trace.steps["running"]).sum()) - 1
    made = style.figure(5.6, f"cut_in: the last two seconds of scenario {seed}")
    for axes, before in zip(made.subplots(len(BEFORE_S), 1, sharex=True), BEFORE_S, strict=True):
        step = end - round(before * FACTS.decision_hz)
        observation = torch.as_tensor(trace.steps["observation"][step][0])
        rows = physical(observation)[observation[:, 0] > 0]
        ego = float(rows[0, 1])
        road.lanes(axes, 3, REACH)
        road.cars(axes, [(float(x), ego + float(y)) for x, y, *_ in rows[1:]], style.BLUE)
        road.cars(axes, [(0.0, ego)], style.ORANGE)
        axes.set_ylabel(
            f"{before:g} s before\n{float(rows[0, 2]):.0f} m/s", rotation=0, ha="right", va="center", fontsize=9
        )
    axes.set_xlabel("m along the road from the victim (orange)")
    return made
