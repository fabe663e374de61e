"""The worlds in SUMO's traffic from above, and crashes as cavbench sees them. It needs SUMO: `pip install 'cavbench[sumo]'`."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from cavbench.driving import Control
from cavbench.envs.highway.config import ACTIONS
from cavbench.envs.highway.engine import Flag
from cavbench.envs.sumo.axes import SUMO_CROSSING_V1, SUMO_V1
from cavbench.envs.sumo.cars import PERIOD_MS
from cavbench.envs.sumo.crossing import MIDDLE
from cavbench.envs.sumo.crossing_world import SumoCrossingWorld
from cavbench.envs.sumo.engine import SumoEngine
from cavbench.envs.sumo.motorway import LENGTH, MERGE, MERGE_LENGTH, RAMP_ASIDE, RAMP_LENGTH, RAMP_STRAIGHT
from cavbench.envs.sumo.world import SumoWorld
from docs.figures import style
from docs.figures.roads import GREY, cars

LANES, SEED = 3, SUMO_V1.first_seed
MOMENTS = (120, 210)
SHOWN = (340, 800)
"""m along the road; the ego is always there."""
CROSSED, BEFORE_CROSSING = SUMO_CROSSING_V1.first_seed + 18, 150
"""A scenario in which a car that goes on meets one from the side, and decisions."""
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


def crossing() -> Figure:
    """A scenario that SUMO's IDM drives, and the end of the same one where the ego goes on."""
    world = SumoCrossingWorld()
    cell = world.axes.cell(lanes=2, density=2.0, rule="yield")
    made = style.figure(3.4, "sumo_crossing: lanes 2, density 2, yield")
    for axes, driver in zip(made.subplots(1, 2), ("idm", "agent"), strict=True):
        engine = SumoEngine(world.configuration((cell,), Control(driver=driver)), world.scene())  # type: ignore[arg-type]
        engine.reset(np.array([0]), np.array([CROSSED]))
        for _ in range(BEFORE_CROSSING):
            engine.step(np.array([ACTIONS.index("FASTER")]))
        for lane in world.facts_at(cell).lanes:
            (x, y), (end_x, end_y) = lane.line
            low, size = (min(x, end_x), min(y, end_y)), (abs(end_x - x), abs(end_y - y))
            along = size[0] > size[1]
            corner = (low[0], low[1] - 2) if along else (low[0] - 2, low[1])
            axes.add_patch(Rectangle(corner, *((size[0], 4.0) if along else (4.0, size[1])), color=GREY, lw=0))
        for y in (-4 * cell.lanes + 2, 4 * cell.lanes - 6):
            axes.plot([MIDDLE - 45, MIDDLE + 45], [y, y], color="white", lw=0.8, ls=(0, (6, 4)))
        bodies = [{name: round(float(car[name]), 3) for name in FIELDS} | BODY for car in engine.vehicles[0]]
        near = [body for body in bodies if abs(body["x"] - MIDDLE) < 48 and abs(body["y"]) < 48]
        cars(axes, near)  # type: ignore[arg-type]
        axes.set(xlim=(MIDDLE - 45, MIDDLE + 45), ylim=(43, -47), xticks=[], yticks=[], aspect=1)
        seconds = engine.episodes["steps"][0] * PERIOD_MS / 1000
        axes.set_title(f"{'IDM waits' if driver == 'idm' else 'the ego goes on'}, {seconds:.1f} s", fontsize=10)
        engine.processes.close()
    return made


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
