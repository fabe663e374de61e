"""The motorway of `sumo` from above, and a crash as cavbench sees it. It needs SUMO: `pip install 'cavbench[sumo]'`."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from cavbench.driving import Control
from cavbench.envs.highway.engine import Flag
from cavbench.envs.sumo.axes import SUMO_V1
from cavbench.envs.sumo.cars import PERIOD_MS
from cavbench.envs.sumo.engine import SumoEngine
from cavbench.envs.sumo.motorway import LENGTH, MERGE, MERGE_LENGTH, RAMP_ASIDE, RAMP_LENGTH, RAMP_STRAIGHT
from cavbench.envs.sumo.world import SumoWorld
from docs.figures import style
from docs.figures.roads import GREY, cars

LANES, SEED = 3, SUMO_V1.first_seed
MOMENTS = (120, 210)
SHOWN = (340, 800)
"""m along the road; the ego is always there."""
BODY = {"length": 5.0, "width": 2.0}


def sumo() -> Figure:
    """The first 14 s of a scenario that SUMO's IDM drives, and the end of one in which the ego steers into a car beside it."""
    cell = SumoWorld().axes.cell(lanes=LANES, density=2.0)
    made = style.figure(4.6, f"sumo: lanes {LANES}, density 2")
    every = made.subplots(len(MOMENTS) + 1, 1)
    engine = SumoEngine(SumoWorld().configuration((cell,), Control(driver="idm")), SumoWorld().scene())
    engine.reset(np.array([0]), np.array([SEED]))
    for axes, moment in zip(every[:-1], MOMENTS, strict=True):
        while engine.episodes["steps"][0] < moment:
            engine.step(np.array([1]))
        drawn(axes, engine)
        axes.set(xlim=SHOWN, ylim=(24, -4), yticks=[], aspect=3)
        axes.set_title(f"{moment * PERIOD_MS / 1000:.0f} s", fontsize=10)
    engine.processes.close()
    crash(every[-1], cell)
    return made


def crash(axes: Axes, cell: object) -> None:
    """The ego steers to the left until its body overlaps another one."""
    engine = SumoEngine(SumoWorld().configuration((cell,), Control(action_type="continuous")), SumoWorld().scene())  # type: ignore[arg-type]
    engine.reset(np.array([0]), np.array([SEED]))
    other = engine.vehicles[0, int(np.argmin(np.abs(engine.vehicles["y"][0, 1:] - 4.0))) + 1]
    ego = engine.vehicles[0, 0]
    for name, value in (("x", other["x"] - 1), ("y", other["y"] + 4.0), ("speed", other["speed"])):
        ego[name] = value
    while not engine.flags[Flag.DONE, 0]:
        engine.step(np.array([[0.0, -0.02]]))
    drawn(axes, engine)
    x, y = float(ego["x"]), float(ego["y"])
    axes.set(xlim=(x - 26, x + 26), ylim=(y + 4, y - 5), yticks=[], aspect=1)
    axes.set_title("a crash: two bodies overlap, whatever lanes SUMO has them on", fontsize=10)
    engine.processes.close()


def drawn(axes: Axes, engine: SumoEngine) -> None:
    """Draw the road, and the bodies of the cars on it."""
    bottom = 4.0 * LANES - 2
    axes.add_patch(Rectangle((0, -2), LENGTH, bottom + 2, color=GREY, lw=0))
    begin, bend, end = MERGE - RAMP_LENGTH, MERGE - RAMP_STRAIGHT, MERGE + MERGE_LENGTH
    edge = np.array([[begin, bottom + RAMP_ASIDE], [bend, bottom], [end, bottom]])
    axes.fill(*np.concatenate([edge, edge[::-1] + np.array([0, 4])]).T, color=GREY, lw=0)
    for lane in range(1, LANES):
        axes.axhline(4 * lane - 2, color="white", lw=0.8)
    axes.plot([bend, MERGE], [bottom, bottom], color="white", lw=1.6)
    axes.plot([MERGE, end], [bottom, bottom], color="white", lw=0.8, ls=(0, (6, 4)))
    shown = [car for car in engine.vehicles[0] if SHOWN[0] < car["x"] < SHOWN[1]]
    bodies = [{name: round(float(car[name]), 3) for name in FIELDS} | BODY for car in shown]
    cars(axes, bodies)  # type: ignore[arg-type]


FIELDS = ("x", "y", "cos_heading", "sin_heading")
