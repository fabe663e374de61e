"""The crossing: its road in each weather and through drops, and where the car comes to stand."""

from __future__ import annotations

import torch
from matplotlib.figure import Figure

from cavbench.detection.driver import Memory
from cavbench.detection.stopping import CONFIRMED_IN, SPEED_MPS
from cavbench.envs.camera.braking import Motion, brakes_in
from cavbench.envs.camera.crossing import StopSignCrossing
from cavbench.envs.camera.crossing_axes import AXES
from cavbench.envs.camera.environment import CLEARED_M
from cavbench.envs.camera.poses import CLOSED_LOOP_DISTANCES
from cavbench.envs.camera.street.layout import CROSSING
from cavbench.envs.weather import WEATHERS
from docs.figures import style
from docs.figures.sightings import show

STEP_S, SIGN_PX_M = 0.05, 721.0 * 1.2
CONFIRMED_M = (29.0, 19.0, 16.0, 13.0)
FRAME = CLOSED_LOOP_DISTANCES.index(18.0)
"""The frame shown."""


def world() -> Figure:
    """A frame in each weather, clean and through drops, and speed over distance for four distances of confirmation."""
    made = style.figure(6.0, "crossing: the car stops where its brakes stop it")
    upper, lower = made.subfigures(2, height_ratios=(4, 5))
    weathers, lenses = [str(weather) for weather in AXES["weather"].choices], ("clean", "drops")
    for row, lens in zip(upper.subplots(len(lenses), len(weathers)), lenses, strict=True):
        for axes, weather in zip(row, weathers, strict=True):
            cell = AXES.cell(weather=weather, lens=lens)
            scenes = StopSignCrossing().approaches(cell, range(1))[0].scenes
            show(axes, scenes.render(torch.tensor([FRAME]), None, 0.5)[0][:, :, 300:1000])
            axes.set_title(f"{weather}, {lens}", fontsize=10)
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
    brakes, memory = brakes_in(WEATHERS[weather]), Memory(SIGN_PX_M)
    start = CLOSED_LOOP_DISTANCES[0]
    motion = Motion(torch.tensor([start]), torch.tensor([SPEED_MPS]), torch.zeros(1))
    distances, speeds = [], []
    while float(motion.speed) > 0 and float(motion.distance) > CLEARED_M:
        distance, speed = float(motion.distance), float(motion.speed)
        distances.append(distance)
        speeds.append(speed)
        # It is detected from as many frames before on as it takes to confirm it.
        if 1 < distance <= confirmed_m + (CONFIRMED_IN - 1) * SPEED_MPS * STEP_S + 1e-3:
            half = SIGN_PX_M / distance / 2
            memory = memory.seeing(torch.tensor([[-half, -half, half, half]]), len(distances), start - distance)
        asked, memory = memory.deciding(start - distance, speed)
        motion, memory = brakes.moved(motion, torch.tensor([asked]), STEP_S), memory.after(STEP_S)
    return [*distances, float(motion.distance)], [*speeds, float(motion.speed)]
