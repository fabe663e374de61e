"""The highway: its six roads in clear weather, and the sensor range by weather."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from cavbench.envs.highway.axes import STANDARD_V2
from cavbench.envs.highway.batched import BatchedHighway
from cavbench.envs.highway.sensor import noise_sigma, sensor_range_m
from cavbench.envs.highway.world import HighwayWorld
from cavbench.envs.weather import WEATHERS
from docs.figures import road, style

GRID = STANDARD_V2
SEED = GRID.first_seed
REACH = (-15.0, 215.0)


def world() -> Figure:
    """The cells of the standard grid at the start of a scenario, and the sensor by weather."""
    cells = [cell for cell in GRID.cells() if cell.weather == "clear"]
    env = HighwayWorld().make(cells)
    assert isinstance(env, BatchedHighway)
    engine = env.engine
    engine.reset(np.arange(len(cells)), np.full(len(cells), SEED))
    count = len(GRID.cells())
    made = style.figure(6.8, f"highway: {count} cells, {len(cells)} roads in {len(GRID.values['weather'])} weathers")
    heights = [cell.lanes + 0.8 for cell in cells]
    *roads, sensor = made.subplots(len(cells) + 1, 1, height_ratios=[*heights, 8])
    for number, (axes, cell) in enumerate(zip(roads, cells, strict=True)):
        ego, *others = engine.vehicles[number]
        places = [(float(car["x"] - ego["x"]), float(car["y"])) for car in others]
        road.lanes(axes, cell.lanes, REACH)
        road.cars(axes, [place for place in places if REACH[0] < place[0] < REACH[1]], style.BLUE)
        road.cars(axes, [(0.0, float(ego["y"]))], style.INK)
        axes.set_title(f"{cell.lanes} lanes, density {cell.density:g}", fontsize=10)
        axes.set_xticks([])
    for number, name in enumerate(GRID.values["weather"]):
        weather = WEATHERS[name]
        sensor.barh(number, sensor_range_m(weather), color=style.SKY, height=0.85)
        label = f"{name}: {sensor_range_m(weather):.0f} m, noise {noise_sigma(weather):.2g} m"
        sensor.annotate(label, (2, number), va="center", fontsize=9.5)
    sensor.set(xlim=REACH, yticks=[], xlabel="m ahead")
    sensor.invert_yaxis()
    sensor.spines["left"].set_visible(False)
    sensor.set_title("how far the ego sees, and how noisily", fontsize=10)
    return made
