"""Road networks from above, with their cars at some moments of a scenario."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from numpy.typing import NDArray

from cavbench.core.options import configured
from cavbench.driving import Control, Driver
from cavbench.envs.highway.engine import Flag
from cavbench.envs.roads.axes import MERGE_V1
from cavbench.envs.roads.engine import RoadsEngine
from cavbench.envs.roads.merge_world import MergeWorld
from cavbench.envs.roads.network import LaneKind
from cavbench.envs.roads.shape import points
from docs.figures import style

SEED = MERGE_V1.first_seed
GREY = "#d9dade"
IDLE = 1
Box = tuple[float, float, float, float]


def merge() -> Figure:
    """The merge at density 4: the first ten seconds of a scenario that the traffic's own driver drives."""
    world, moments = MergeWorld(), (0, 60, 105, 150)
    engine = RoadsEngine(world.config((world.axes.cell(density=4.0, ramp=80.0),), Control(driver="idm")))
    engine.reset(np.array([0]), np.array([SEED]))
    made = style.figure(6.8, "merge: density 4, a ramp of 80 m")
    every = made.subplots(len(moments), 1)
    for step in range(max(moments) + 1):
        if step in moments:
            axes = every[moments.index(step)]
            network(axes, engine.roads[0])
            cars(axes, engine.bodies[0][: engine.episodes["bodies"][0]])
            axes.set(xlim=(0, 420), ylim=(20, -6), yticks=[], aspect=2.5)
            if step < max(moments):
                axes.set(xticks=[])
            axes.set_title(f"{step / 15:.0f} s", fontsize=10)
        engine.step(np.array([1]))
    return made


def world(
    name: str, cell: dict[str, Any], moments: tuple[int, int], *, driver: Driver, box: Box, tall: float
) -> Figure:
    """A world from above at two moments of a scenario.

    Args:
        name: the world.
        cell: values of its axes.
        moments: numbers of decisions.
        driver: who drives the ego; `agent` keeps its speed and lane.
        box: lowest and highest x and y in m.
        tall: by what heights are enlarged.
    """
    component: Any = configured("world", name, {}).component
    engine = RoadsEngine(component.config((component.axes.cell(**cell),), Control(driver=driver)))
    engine.reset(np.array([0]), np.array([SEED]))
    low_x, high_x, low_y, high_y = box
    flat = high_x - low_x > 3 * (high_y - low_y)
    made = style.figure(3.8, f"{name}: {', '.join(f'{axis} {value}' for axis, value in cell.items())}")
    every = made.subplots(2, 1) if flat else made.subplots(1, 2)
    for axes, moment in zip(every, moments, strict=True):
        while engine.episodes["steps"][0] < moment:
            engine.step(np.array([IDLE]))
            if engine.flags[Flag.DONE][0]:
                raise RuntimeError(f"the episode of {name} ends after {engine.episodes['steps'][0]} decisions")
        network(axes, engine.roads[0])
        cars(axes, engine.bodies[0][: engine.episodes["bodies"][0]], int(engine.episodes["ego"][0]))
        axes.set(xlim=(low_x, high_x), ylim=(high_y, low_y), xticks=[], yticks=[], aspect=tall)
        axes.set_title(f"{moment / component.policy_frequency:.0f} s", fontsize=10)
    return made


def roundabout() -> Figure:
    return world(
        "roundabout", {"turn": "straight", "density": 2.0}, (30, 90), driver="agent", box=(-60, 60, -60, 60), tall=1
    )


def intersection() -> Figure:
    return world(
        "intersection", {"turn": "left", "density": 1.0}, (0, 45), driver="agent", box=(-60, 60, -60, 60), tall=1
    )


def leave() -> Figure:
    return world("exit", {"lanes": 4, "density": 1.0}, (0, 150), driver="agent", box=(150, 580, -6, 50), tall=2.5)


def two_way() -> Figure:
    return world("two_way", {"density": 1.0}, (0, 150), driver="idm", box=(0, 430, -6, 10), tall=2.5)


def racetrack() -> Figure:
    return world("racetrack", {"cars": 8}, (0, 90), driver="idm", box=(-16, 132, -60, 14), tall=1)


def u_turn() -> Figure:
    return world("u_turn", {"density": 1.0}, (0, 150), driver="idm", box=(-5, 160, -8, 56), tall=1)


def network(axes: Axes, road: np.void) -> None:
    """Draw every lane of a network at its width."""
    for lane in road["lanes"][: road["lane_count"]]:
        # A point for every 6 degrees of a bend looks round.
        turned = lane["length"] / lane["radius"] if lane["kind"] == LaneKind.CIRCULAR else 0.0
        count = 16 if lane["amplitude"] else 2 + int(turned / np.radians(6))
        edges = [points(lane, side * float(lane["width"]) / 2, count) for side in (-1, 1)]
        axes.add_patch(Polygon(np.concatenate([edges[0], edges[1][::-1]]), color=GREY, lw=0))
        # One line with a gap for both edges.
        axes.plot(*np.concatenate([edges[0], [[np.nan, np.nan]], edges[1]]).T, color="white", lw=0.8)


def cars(axes: Axes, bodies: NDArray[np.void], ego: int = 0) -> None:
    """Draw the ego, the other cars and the obstacles."""
    for number, body in enumerate(bodies):
        forward = np.array([body["cos_heading"], body["sin_heading"]]) * body["length"] / 2
        right = np.array([-body["sin_heading"], body["cos_heading"]]) * body["width"] / 2
        centre = np.array([body["x"], body["y"]])
        corners = [
            centre + forward + right,
            centre + forward - right,
            centre - forward - right,
            centre - forward + right,
        ]
        axes.add_patch(Polygon(corners, color=style.INK if number == ego else style.BLUE, lw=0, zorder=3))
