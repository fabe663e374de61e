"""The crossing: its road in each weather, and where the car comes to stand."""

from __future__ import annotations

from dataclasses import replace

import torch
from matplotlib.figure import Figure

from cavbench.detection.driver import Memory
from cavbench.detection.stopping import SPEED_MPS
from cavbench.envs.camera.braking import Motion, brakes_in
from cavbench.envs.camera.crossing import StopSignCrossing
from cavbench.envs.camera.crossing_axes import AXES
from cavbench.envs.camera.environment import CLEARED_M
from cavbench.envs.camera.poses import CLOSED_LOOP_DISTANCES
from cavbench.envs.camera.street.layout import CROSSING
from cavbench.envs.weather import WEATHERS
from docs.figures import style
from docs.figures.sightings import show

STEP_S = 0.05
CONFIRMED_M = (29.0, 19.0, 16.0, 13.0)
FRAME = 24
"""The frame shown, 18 m before the sign."""


def world() -> Figure:
    """A frame in each weather, and speed over distance for signs that are confirmed at different distances."""
    made = style.figure(5.2, "crossing: the car stops where its brakes stop it")
    upper, lower = made.subfigures(2, height_ratios=(1, 2))
    weathers = [str(weather) for weather in AXES["weather"].choices]
    for axes, weather in zip(upper.subplots(1, len(weathers)), weathers, strict=True):
        scenes = StopSignCrossing().approaches(AXES.cell(weather=weather), range(1))[0].scenes
        show(axes, scenes.render(torch.tensor([FRAME]), None, 0.5)[0][:, :, 300:1000])
        axes.set_title(weather, fontsize=10)
    axes = lower.subplots()
    colours = (style.GREEN, style.BLUE, style.ORANGE, style.RED)
    for confirmed, colour in zip(CONFIRMED_M, colours, strict=True):
        for weather, dash in (("clear", "-"), ("rain", "--")):
            label = f"confirmed at {confirmed:.0f} m" if weather == "clear" else None
            axes.plot(*_driven(confirmed, weather), dash, color=colour, label=label)
    axes.axvline(0, color="black", lw=1)
    axes.axvspan(-CROSSING[1], -CROSSING[0], color="0.9")
    axes.annotate("crossing\nroad", (-sum(CROSSING) / 2, SPEED_MPS / 2), ha="center", va="center", fontsize=10)
    axes.set(xlabel="distance to the line, m (solid: dry road, dashed: wet)", ylabel="speed, m/s", xlim=(30, -13))
    axes.legend(loc="lower left", fontsize=9)
    return made


def _driven(confirmed_m: float, weather: str) -> tuple[list[float], list[float]]:
    """Distance and speed at each step of a car at 10 m/s whose driver confirms the sign at a distance."""
    brakes, memory = brakes_in(WEATHERS[weather]), Memory.initial(1)
    motion = Motion(torch.tensor([CLOSED_LOOP_DISTANCES[0]]), torch.tensor([SPEED_MPS]), torch.zeros(1))
    distances, speeds = [], []
    while float(motion.speed) > 0 and float(motion.distance) > CLEARED_M:
        distances.append(float(motion.distance))
        speeds.append(float(motion.speed))
        if float(motion.distance) <= confirmed_m and not float(memory.confirmed_m):
            memory = replace(memory, confirmed_m=motion.distance)
        asked, memory = memory.deciding(motion.distance, motion.speed)
        motion, memory = brakes.moved(motion, asked, STEP_S), memory.after(STEP_S)
    return [*distances, float(motion.distance)], [*speeds, float(motion.speed)]
