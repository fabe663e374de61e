"""Adversarial training: what is left of a victim under attack, hardened or not."""

from __future__ import annotations



import numpy as np

import pyarrow.compute as pc

from matplotlib.figure import Figure

from bench.config import run_config
from bench.drive import drive
from bench.plan import plan

from docs.figures import style
from docs.figures.sightings import curve, frame_axes, patched
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


def none() -> Figure:
    """What undefended victims keep, from the published records."""
    made = style.figure(3.6, "none: undefended, little is left under attack")
    driving, detection = made.subplots(1, 2, width_ratios=(1.35, 1))
    bars = {victim: {attack: _published(victim, attack) for attack in ("none", "noise", "zo")} for victim in ("dqn", "ddpg")}
    colours = {"none": style.BLUE, "noise": style.GREY, "zo": style.RED}
    for number, attack in enumerate(colours):
        heights = [100 * bars[victim][attack] for victim in bars]
        drawn = driving.bar(np.arange(2) + (number - 1) * 0.27, heights, 0.25, color=colours[attack], label=attack)
        driving.bar_label(drawn, fmt="%.0f", fontsize=9.5)
    driving.set(xticks=(0, 1), xticklabels=list(bars), ylabel="safe progress, %", ylim=(0, 108))
    driving.set_title("driving, linf 0.2", fontsize=10.5)
    driving.legend(loc="upper right", fontsize=9.5, handlelength=1)
    pair = patched("eot")
    confidence = {"none": pair.control["none"], "grey": pair.control["grey_patch"], "noise": pair.control["noise_patch"]}
    confidence["eot"] = pair.measured
    estimates = [100 * measured.confidence.estimate for measured in confidence.values()]
    drawn = detection.bar(range(4), estimates, color=(style.BLUE, style.GREY, style.GREY, style.RED))
    detection.bar_label(drawn, fmt="%.0f", fontsize=9.5)
    detection.set(xticks=range(4), xticklabels=confidence, ylabel="confidence, %", ylim=(0, 108))
    detection.set_title("yolov3_tiny, patches", fontsize=10.5)
    return made


def advtrain_detection() -> Figure:
    """Confidence on the way to the sign, undefended and hardened, from the published records."""
    pairs = {"undefended": patched("eot"), "hardened": patched("eot", "advtrain_detection")}
    left = {name: pair.measured.confidence.estimate for name, pair in pairs.items()}
    title = f"advtrain: confidence under eot {left['undefended']:.2f} undefended,\n{left['hardened']:.2f} hardened"
    made = style.figure(4.0, title)
    for axes, (name, pair) in zip(made.subplots(1, 2, sharey=True), pairs.items(), strict=True):
        curve(axes, pair.controls["none"].table, style.BLUE, "no patch")
        curve(axes, pair.own.table, style.RED, "eot", "--")
        frame_axes(axes)
        axes.set_title(f"yolov3_tiny, {name}", fontsize=10.5)
    made.axes[1].set_ylabel("")
    made.legend(*made.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return made


def _published(victim: str, attack: str) -> float:
    """Mean safe progress of an undefended victim on one road, of the published records."""
    records = published("driving")
    wanted = {"attack": attack, "defense": "none", "victim": victim, "lanes": 3, "density": 1.0, "weather": "clear"}
    for name, value in wanted.items():
        records = records.filter(pc.equal(records[name], value))
    return float(pc.mean(records["safe_progress"]).as_py())
