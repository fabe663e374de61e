"""The baseline drivers: published records of one road, and one scenario driven again."""

from __future__ import annotations

import json

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import torch
from matplotlib.figure import Figure

from cavbench.core.pair import choose
from cavbench.core.track import track
from cavbench.envs.highway.axes import AXES
from cavbench.envs.highway.dynamics import LANE_WIDTH
from cavbench.leaderboard.published import published
from cavbench.scenarios import Cell
from docs.figures import style
from docs.figures.driving import FACTS, episode, physical

SECONDS = 30
CELL = AXES.cell(lanes=3, density=1.0, weather="clear")
ROAD = "3 lanes, density 1, clear, 100 scenarios"


def blind() -> Figure:
    """Reward and safe progress: reward alone is a broken score."""
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
    """How long random drivers stay on the road."""
    records = _records("random")
    params = {actions: choose("victim", "random", actions=actions).params for actions in ("discrete", "continuous")}
    lasted = {
        name: records.filter(pc.equal(records["victim_params"], each))["steps"].to_numpy()
        for name, each in params.items()
    }
    half = {actions: np.median(steps) / FACTS.decision_hz for actions, steps in lasted.items()}
    made = style.figure(
        3.4, f"random: half are off after {half['discrete']:.0f} s, or {half['continuous']:.0f} s steering"
    )
    axes = made.subplots()
    steps = np.arange(round(SECONDS * FACTS.decision_hz))
    for actions, colour, dashes in (("discrete", style.ORANGE, "-"), ("continuous", style.BLUE, "--")):
        left = (lasted[actions][:, None] > steps).mean(0)
        axes.plot(steps / FACTS.decision_hz, 100 * left, color=colour, ls=dashes, lw=2.4)
    axes.annotate("random lane changes and speeds", (12, 62), color=style.ORANGE)
    axes.annotate("random steering", (4.5, 4), color=style.BLUE)
    axes.set(xlabel="time (s)", ylabel="still driving, %", xlim=(0, SECONDS), ylim=(-2, 103))
    axes.set_title(ROAD, fontsize=10)
    return made


def idm() -> Figure:
    """Speed and lane of the traffic driver and of `dqn` on one scenario."""
    return _beside_dqn("idm", "idm: highway-env's own driver is safe, and slow")


def clairvoyant() -> Figure:
    """Speed and lane of the planner with perfect information and of `dqn` on one scenario."""
    return _beside_dqn("clairvoyant", "clairvoyant: it finds the gaps, and knows that they stay")


def _beside_dqn(name: str, title: str) -> Figure:
    made = style.figure(4.2, title)
    speed, lane = made.subplots(2, 1, sharex=True, height_ratios=(1.4, 1))
    for victim, colour, dashes in ((name, style.BLUE, "-"), ("dqn", style.RED, "--")):
        columns, steps = episode("attack=none", f"victim={victim}")
        seconds = np.arange(len(steps["speed"])) / FACTS.decision_hz
        label = f"{victim}: {columns['distance_m'][0]:.0f} m, safe progress {columns['safe_progress'][0]:.0%}"
        speed.plot(seconds, steps["speed"], color=colour, ls=dashes, lw=2.2, label=label)
        across = physical(torch.tensor(steps["observation"]))[:, 0, 1]
        lane.plot(seconds, across / LANE_WIDTH, color=colour, ls=dashes, lw=2.2)
    speed.set(ylabel="speed (m/s)", xlim=(0, SECONDS))
    speed.legend(loc="lower left", bbox_to_anchor=(0, 1.0), fontsize=10.5)
    lane.set(xlabel="time (s)", ylabel="lane", yticks=(0, 1, 2), ylim=(2.3, -0.3))
    lane.set_yticklabels(("left", "middle", "right"))
    return made


def _records(victim: str | None = None) -> pa.Table:
    """The published clean episodes of undefended drivers on one road."""
    records = published(track("driving"))
    wanted = {"attack": "none", "defense": "none"} | ({"victim": victim} if victim else {})
    for name, value in wanted.items():
        records = records.filter(pc.equal(records[name], value))
    cells = [text for text in pc.unique(records["cell"]).to_pylist() if Cell(**json.loads(text)) == CELL]
    return records.filter(pc.is_in(records["cell"], pa.array(cells)))


def _scores() -> dict[str, tuple[float, float]]:
    """Reward as a share of the maximum, and safe progress, of each driver; mean over scenarios and training seeds."""
    found: dict[str, tuple[float, float]] = {}
    records = _records()
    records = records.filter(pc.is_in(records["victim"], pa.array(["blind", "ddpg", "dqn", "idm", "random"])))
    groups = records.group_by(["victim", "victim_params"], use_threads=False)
    means = groups.aggregate([("return", "mean"), ("safe_progress", "mean")])
    for row in means.to_pylist():
        params = json.loads(row["victim_params"])
        name = params["policy"] if row["victim"] == "blind" else row["victim"]
        if params.get("actions") != "continuous":
            found[name] = row["return_mean"] / FACTS.max_steps, row["safe_progress_mean"]
    return found
