"""Road networks from above, with their cars at some moments of a scenario."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from numpy.typing import NDArray

from cavbench.driving import Control
from cavbench.envs.roads.axes import MERGE_V1
from cavbench.envs.roads.engine import RoadsEngine
from cavbench.envs.roads.merge_world import MergeWorld
from cavbench.envs.roads.network import LaneKind
from docs.figures import style

SEED = MERGE_V1.first_seed
GREY = "#d9dade"


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
            axes.set_title(f"{step / 15:.0f} s", fontsize=10)
        engine.step(np.array([1]))
    return made


def network(axes: Axes, road: np.void) -> None:
    """Draw every lane of a network at its width."""
    for lane in road["lanes"][: road["lane_count"]]:
        edges = [points(lane, side * float(lane["width"]) / 2) for side in (-1, 1)]
        axes.add_patch(Polygon(np.concatenate([edges[0], edges[1][::-1]]), color=GREY, lw=0))
        for edge in edges:
            axes.plot(*edge.T, color="white", lw=0.8)


def points(lane: np.void, across: float) -> NDArray[np.float64]:
    """[60, 2] points along a lane, so many m to the right of its centre."""
    along = np.linspace(0, float(lane["length"]), 60)
    if lane["kind"] == LaneKind.CIRCULAR:
        angle = lane["turn"] * along / lane["radius"] + lane["start_phase"]
        radius = lane["radius"] - across * lane["turn"]
        return np.stack([lane["center_x"] + radius * np.cos(angle), lane["center_y"] + radius * np.sin(angle)], 1)
    off = across + lane["amplitude"] * np.sin(lane["pulsation"] * along + lane["phase"])
    x = lane["start_x"] + along * lane["direction_x"] - off * lane["direction_y"]
    return np.stack([x, lane["start_y"] + along * lane["direction_y"] + off * lane["direction_x"]], 1)


def cars(axes: Axes, bodies: NDArray[np.void]) -> None:
    """Draw the ego, which is the first, the other cars and the obstacles."""
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
        axes.add_patch(Polygon(corners, color=style.INK if number == 0 else style.BLUE, lw=0, zorder=3))
