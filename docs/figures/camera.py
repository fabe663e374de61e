"""The camera world: every place in every weather."""

from __future__ import annotations

from matplotlib.figure import Figure

from docs.figures import style
from docs.figures.sightings import FRAME, approaches, picture, show
from envs.weather import WEATHERS

WINDOW = 400, 230
"""Width and height in pixels of the shown part of each frame."""


def world() -> Figure:
    """One frame of each place in each weather."""
    places = [approach.location for approach in approaches()]
    made = style.figure(5.1, f"camera: {len(places)} places to be scored on, {len(WEATHERS)} weathers")
    panels = made.subplots(len(WEATHERS), len(places))
    for row, weather in zip(panels, WEATHERS, strict=True):
        for axes, approach in zip(row, approaches(weather), strict=True):
            left, top, right, bottom = approach.scenes.boxes[FRAME].tolist()
            height, width = approach.scenes.size
            x = round(min(max((left + right - WINDOW[0]) / 2, 0), width - WINDOW[0]))
            y = round(min(max((top + bottom - WINDOW[1]) / 2, 0), height - WINDOW[1]))
            show(axes, picture(approach, FRAME)[:, y : y + WINDOW[1], x : x + WINDOW[0]])
        row[0].set_ylabel(weather)
    for axes, place in zip(panels[0], places, strict=True):
        axes.set_title(place.replace("-", " "), fontsize=10.5)
    return made
