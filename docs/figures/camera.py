"""The camera world: every place in every weather, the decoys, and the windscreen."""

from __future__ import annotations

from copy import copy

import torch
from matplotlib.figure import Figure
from torch import Tensor

from cavbench.detection import Approach
from cavbench.envs.camera.faces import DECOYS
from cavbench.envs.camera.places import StopSignPlaces
from cavbench.envs.camera.windscreen import Windscreen
from cavbench.envs.camera.windscreen_axes import AXES, LENSES
from cavbench.envs.weather import WEATHERS
from docs.figures import style
from docs.figures.sightings import DENSITY, FRAME, LANES, approaches, picture, show

WINDOW = 400, 230
"""Width and height in pixels of the shown part of each frame."""
NEAR = 8
"""Index of the frame that is shown through the windscreen: some 10 m before the sign, where motion blur is seen."""


def world() -> Figure:
    """One frame of each place in each weather."""
    places = [approach.location for approach in approaches()]
    made = style.figure(5.1, f"camera: {len(places)} places to be scored on, {len(WEATHERS)} weathers")
    panels = made.subplots(len(WEATHERS), len(places))
    for row, weather in zip(panels, WEATHERS, strict=True):
        for axes, approach in zip(row, approaches(weather), strict=True):
            show(axes, _around_the_sign(approach))
        row[0].set_ylabel(weather)
    for axes, place in zip(panels[0], places, strict=True):
        axes.set_title(place.replace("-", " "), fontsize=10.5)
    return made


def _around_the_sign(approach: Approach) -> Tensor:
    """`FRAME` of an approach, cut to `WINDOW` around the sign."""
    left, top, right, bottom = approach.scenes.boxes[FRAME].tolist()
    height, width = approach.scenes.size
    x = round(min(max((left + right - WINDOW[0]) / 2, 0), width - WINDOW[0]))
    y = round(min(max((top + bottom - WINDOW[1]) / 2, 0), height - WINDOW[1]))
    return picture(approach, FRAME)[:, y : y + WINDOW[1], x : x + WINDOW[0]]


def places() -> Figure:
    """One frame of each of the ten places, in clear weather."""
    world = StopSignPlaces()
    found = world.approaches(world.axes.cell(weather="clear"), range(len(world.locations)))
    made = style.figure(2.2, f"places: {len(found)} places, one road")
    for axes, approach in zip(made.subplots(2, len(found) // 2).flat, found, strict=True):
        show(axes, _around_the_sign(approach))
        axes.set_title(approach.location.replace("-", " "), fontsize=9)
    return made


def decoys() -> Figure:
    """One frame with the stop sign and with each decoy, clear and in rain."""
    made = style.figure(2.1, "The stop sign and the decoys")
    panels = made.subplots(2, 1 + len(DECOYS))
    for row, weather, place in zip(panels, ("clear", "rain"), (0, 1), strict=True):
        approach = approaches(weather)[place]
        scenes = copy(approach.scenes)
        left, top, right, bottom = scenes.boxes[FRAME].tolist()
        x, y, half = round((left + right) / 2), round((top + bottom) / 2), round(0.8 * (right - left))
        window = slice(None), slice(max(y - half, 0), y + half), slice(x - half, x + half)
        show(row[0], picture(approach, FRAME)[window])
        for axes, decoy in zip(row[1:], DECOYS, strict=True):
            scenes.decoys = (decoy,) * len(scenes)
            show(axes, scenes.render_decoys(torch.tensor([FRAME]))[0][window])
        row[0].set_ylabel(weather)
    for axes, name in zip(panels[0], ("stop sign", *(decoy.name for decoy in DECOYS)), strict=True):
        axes.set_title(name, fontsize=10)
    return made


def windscreen() -> Figure:
    """One frame with each lens, clear and in rain."""
    made = style.figure(1.75, "windscreen: drops, glare and motion blur")
    panels = made.subplots(2, len(LENSES))
    for row, weather in zip(panels, ("clear", "rain"), strict=True):
        for axes, lens in zip(row, LENSES, strict=True):
            cell = AXES.cell(lanes=LANES, density=DENSITY, weather=weather, lens=lens)
            (approach,) = Windscreen().approaches(cell, range(1))
            left, top, right, _ = approach.scenes.boxes[NEAR].tolist()
            x, y = round((left + right) / 2 - WINDOW[0] / 2), max(round(top) - 60, 0)
            show(axes, picture(approach, NEAR)[:, y : y + WINDOW[1], x : x + WINDOW[0]])
        row[0].set_ylabel(weather)
    for axes, lens in zip(panels[0], LENSES, strict=True):
        axes.set_title(lens, fontsize=10)
    return made
