"""Platoons: how a wave goes down the cars."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from cavbench.driving import Control
from cavbench.envs.platoon.axes import PLATOON_V1
from cavbench.envs.platoon.engine import PlatoonEngine
from cavbench.envs.platoon.world import PlatoonWorld
from docs.figures import style

PLACE, STEPS, FROM = 8, 450, 50
"""The driven car is the last one, behind seven followers of the world, and is not drawn."""


def world() -> Figure:
    """The speeds of a leader and seven followers, with the gains and the time gap of Ploeg et al. 2011."""
    made = style.figure(3.6, "A leader that brakes, and seven followers 0.7 s apart")
    for axes, (law, title) in zip(
        made.subplots(1, 2, sharey=True), (("cacc", "messages and radar"), ("acc", "radar alone")), strict=True
    ):
        platoon = PlatoonWorld(followers=law, behind=0, noise=0.0)  # type: ignore[arg-type]
        cell = platoon.axes.cell(place=PLACE, cycle="braking")
        engine = PlatoonEngine(platoon.configuration([cell], Control(driver="clairvoyant")))
        engine.reset(np.array([0]), np.array([PLATOON_V1.first_seed]))
        speeds = []
        for _ in range(STEPS):
            engine.step(np.array([0]))
            speeds.append(engine.platoons.v[0, :PLACE].copy())
        seconds = np.arange(STEPS) / 10
        for car, values in enumerate(np.stack(speeds, 1)):
            share = car / (PLACE - 1)
            colour = style.INK if car == 0 else (0.83 * (1 - share), 0.37 * (1 - share) + 0.2, 0.7 * share)
            axes.plot(seconds[FROM:], values[FROM:], color=colour, lw=1.6 if car == 0 else 1.0)
        axes.set(title=title, xlabel="time, s", xlim=(FROM / 10, STEPS / 10))
    made.axes[0].set_ylabel("speed, m/s")
    return made
