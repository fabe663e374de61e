"""The reference drivers, from the published records of one road, and one scenario driven again."""

from __future__ import annotations

import json

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib.figure import Figure

from bench.metrics import MAX_RETURN
from docs.figures import style
from docs.figures.driving import episode
from leaderboard.published import published

STEPS_PER_SECOND, SECONDS = 15, 30
ROAD = "3 lanes, density 1, clear, 100 scenarios"


def blind() -> Figure:
    """Reward against safe progress: why reward alone is no score."""
    points = _scores()
    braking = points["slower"]
    title = f"blind: braking alone earns {braking[0]:.0%} of the reward,\nbut {braking[1]:.0%} safe progress"
    made = style.figure(4.3, title)
    axes = made.subplots()
    left = (-9, -4)
    beside = {"dqn": left, "ddpg": left, "right_then_slower": left, "slower": (9, -4), "idm": (9, -4)}
    for name, (reward, progress) in points.items():
        colour = {"dqn": style.GREEN, "ddpg": style.GREEN, "idm": style.GREY, "random": style.GREY}.get(name, style.RED)
        axes.plot(100 * reward, 100 * progress, "o", ms=8, color=colour)
        if place := beside.get(name):
            said = {"ha": "left" if place[0] > 0 else "right", "textcoords": "offset points"}
            axes.annotate(name.replace("_", " "), (100 * reward, 100 * progress), place, **said)
    axes.annotate("all other constant actions,\nand random (grey)", (28, 8), ha="center", va="bottom", fontsize=10)
    axes.set(xlabel="reward, % of the maximum", ylabel="safe progress, %", xlim=(0, 112), ylim=(-4, 100))
    axes.set_title(f"red: blind, green: learned ({ROAD})", fontsize=10)
    return made


def random() -> Figure:
    """How long random drivers last."""
    records = _records("random")
    made = style.figure(3.4, "")
    axes = made.subplots()
    lasted = {}
    for actions, colour, style_ in (("discrete", style.ORANGE, "-"), ("continuous", style.BLUE, "--")):
        chosen = records.filter(pc.equal(records["victim_params"], json.dumps({"actions": actions}, separators=(",", ":"))))
        seconds = np.sort(chosen["steps"].to_numpy()) / STEPS_PER_SECOND
        left = 100 * (1 - np.arange(len(seconds) + 1) / len(seconds))
        over = seconds < SECONDS
        times = np.concatenate(([0.0], seconds[over], [SECONDS]))
        axes.step(times, np.append(left[: over.sum() + 1], left[over.sum()]), where="post", color=colour, ls=style_, lw=2.4)
        lasted[actions] = float(np.median(seconds)), left[over.sum()]
    axes.annotate("random lane changes and speeds", (12, 62), color=style.ORANGE, fontsize=11)
    axes.annotate("random steering", (4.5, 4), color=style.BLUE, fontsize=11)
    made.suptitle(
        f"random: half are off after {lasted['discrete'][0]:.0f} s, or {lasted['continuous'][0]:.0f} s steering",
        x=0.01,
        ha="left",
        fontsize=12.5,
        fontweight="bold",
    )
    axes.set(xlabel="time (s)", ylabel="still driving, %", xlim=(0, SECONDS), ylim=(-2, 103))
    axes.set_title(ROAD, fontsize=10)
    return made


def idm() -> Figure:
    """Speed and lane of the traffic driver and of `dqn` on one scenario."""
    title = "idm: highway-env's own driver is safe, and slow"
    made = style.figure(4.2, title)
    speed, lane = made.subplots(2, 1, sharex=True, height_ratios=(1.4, 1))
    for victim, colour, dashes in (("idm", style.BLUE, "-"), ("dqn", style.RED, "--")):
        columns, steps = episode("attack=none", f"victim={victim}")
        seconds = np.arange(len(steps["speed"])) / STEPS_PER_SECOND
        label = f"{victim}: {columns['distance_m'][0]:.0f} m, safe progress {columns['safe_progress'][0]:.0%}"
        speed.plot(seconds, steps["speed"], color=colour, ls=dashes, lw=2.2, label=label)
        # The ego's own row is absolute: y is in units of 20 m, and a lane is 4 m wide.
        lane.plot(seconds, steps["observation"][:, 0, 2] * 20 / 4 + 1, color=colour, ls=dashes, lw=2.2)
    speed.set(ylabel="speed (m/s)", xlim=(0, SECONDS))
    speed.legend(loc="lower left", bbox_to_anchor=(0, 1.0), fontsize=10.5)
    lane.set(xlabel="time (s)", ylabel="lane", yticks=(1, 2, 3), ylim=(3.3, 0.7))
    lane.set_yticklabels(("left", "middle", "right"))
    return made


def _records(victim: str | None = None) -> pa.Table:
    """The published clean episodes of undefended drivers on one road."""
    records = published("driving")
    wanted = {"attack": "none", "defense": "none", "lanes": 3, "density": 1.0, "weather": "clear"}
    if victim:
        wanted["victim"] = victim
    for name, value in wanted.items():
        records = records.filter(pc.equal(records[name], value))
    return records


def _scores() -> dict[str, tuple[float, float]]:
    """Reward as a share of the maximum, and safe progress, of each driver; mean over scenarios and training seeds."""
    found: dict[str, tuple[float, float]] = {}
    means = _records().group_by(["victim", "victim_params"]).aggregate([("return", "mean"), ("safe_progress", "mean")])
    for row in means.to_pylist():
        params = json.loads(row["victim_params"])
        name = params["policy"] if row["victim"] == "blind" else row["victim"]
        if params.get("actions") != "continuous":
            found[name] = row["return_mean"] / MAX_RETURN, row["safe_progress_mean"]
    return found
