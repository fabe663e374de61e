"""Decision maps: the action of a trained driver for a car ahead."""

from __future__ import annotations

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from torch import Tensor

from cavbench.envs.highway.config import ACTIONS
from cavbench.envs.highway.dynamics import LANE_WIDTH
from docs.figures import style
from docs.figures.driving import FEATURES, policy

ROWS = 10
EGO_SPEED = 25.0
FROM_START = 100.0
"""Observed position of the ego along the road in m: clipped to the sensor's range after the first seconds."""
DISTANCE = np.linspace(8, 100, 93)
CLOSING = np.linspace(-5, 15, 81)
BLOCKED = (-8.0, 0.0, 8.0, 16.0)
"""Positions in m ahead of the ego of the cars in the neighbouring lanes, which have the ego's speed."""
ROADS = {"lanes beside free": (), "cars on both sides": BLOCKED}


def dqn() -> Figure:
    """The greedy action by distance and closing speed, with the neighbouring lanes free and blocked."""
    return _greedy("dqn", "dqn: passes on the right, brakes where it is boxed in")


def ppo() -> Figure:
    """The most likely action, as for `dqn`."""
    return _greedy("ppo", "ppo: the most likely action")


def sac() -> Figure:
    """The most likely action, as for `dqn`."""
    return _greedy("sac", "sac: the most likely action")


def _greedy(victim: str, title: str) -> Figure:
    made = style.figure(4.1, title)
    with torch.no_grad():
        for axes, (name, beside) in zip(made.subplots(1, 2, sharey=True), ROADS.items(), strict=True):
            action = policy(victim).decide(_observations(beside))
            _map(axes, action, name, ListedColormap(list(style.ACTIONS.values())), (-0.5, len(ACTIONS) - 0.5))
    made.axes[0].set_ylabel("closing speed (m/s), own: 25")
    patches = [Patch(color=style.ACTIONS[name], label=name) for name in ACTIONS]
    made.legend(handles=patches, loc="outside lower center", ncols=5, fontsize=9.5, handlelength=1, columnspacing=1)
    return made


def ddpg() -> Figure:
    """Acceleration and steering by distance and closing speed."""
    made = style.figure(4.3, "ddpg: brakes and steers right behind a car ahead")
    with torch.no_grad():
        action = policy("ddpg").decide(_observations(()))
    halves = (action[..., 0] * 5, action[..., 1] * 45)
    names = ("acceleration (m/s²)", "steering (°, + is right)")
    for axes, values, name in zip(made.subplots(1, 2, sharey=True), halves, names, strict=True):
        reach = float(values.abs().max())
        drawn = _map(axes, values, name, "PuOr_r", (-reach, reach))
        made.colorbar(drawn, ax=axes, location="bottom", aspect=16)
    made.axes[0].set_ylabel("closing speed (m/s), own: 25")
    return made


def _observations(beside: tuple[float, ...]) -> Tensor:
    """[closing speeds, distances, V, F]: the ego in the middle of three lanes, one car ahead of it, and cars on both sides."""
    closing, distance = np.meshgrid(CLOSING, DISTANCE, indexing="ij")
    cars = np.zeros((*closing.shape, ROWS, 5))
    cars[..., 0, :] = 1, FROM_START, LANE_WIDTH, EGO_SPEED, 0
    cars[..., 1, 0], cars[..., 1, 1], cars[..., 1, 3] = 1, distance, -closing
    for number, (side, x) in enumerate((side, x) for x in beside for side in (-LANE_WIDTH, LANE_WIDTH)):
        cars[..., 2 + number, :] = 1, x, side, 0, 0
    high = np.array([1.0, *FEATURES.high])
    return torch.tensor(cars / high, dtype=torch.float32)


def _map(
    axes: Axes, values: Tensor, title: str, colours: str | ListedColormap, limits: tuple[float, float]
) -> QuadMesh:
    axes.set(xlabel="m to the car ahead")
    axes.set_title(title, fontsize=10.5)
    axes.axhline(0, color=style.INK, lw=0.8, ls=":")
    return axes.pcolormesh(DISTANCE, CLOSING, values, cmap=colours, vmin=limits[0], vmax=limits[1], rasterized=True)
