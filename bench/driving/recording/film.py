"""The film of an episode: the road from above, the decisions, and the perturbation against its budget."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from itertools import cycle, islice

import numpy as np
from numpy.typing import NDArray

from cavbench.driving.recording.episode import Array, Episode
from cavbench.driving.recording.plan import Plan
from cavbench.driving.recording.scene import CAR_LENGTH, CAR_WIDTH, DASH, DASH_EVERY, LANE_WIDTH, edges
from cavbench.recording import about
from cavbench.recording.film.drawing import (
    BLACK,
    BLUE,
    CYCLE,
    GREEN,
    GREY,
    PALE,
    ROAD,
    SKY,
    TINT,
    VERMILLION,
    Colour,
    blank,
    box,
    line,
    stroke,
    write,
)
from cavbench.recording.film.film import Film, Picture

WIDTH = 960
BEHIND, AHEAD = 35.0, 85.0
"""Metres of road behind and ahead of the ego that are shown."""
SCALE = WIDTH / (BEHIND + AHEAD)
"""Pixels a metre."""
HIGH = 56.0
"""Metres of the picture from above to below the ego, where the road bends."""
GRASS: Colour = (228, 233, 222)
HEADER, MARGIN, KEY, BAND, LEGEND, VALUES, PLOT = 36, 10, 22, 22, 26, 16, 62
LEFT = 170
"""Where the time axes begin; their labels are before it."""
RIGHT = WIDTH - 20


class EpisodeFilm(Film):
    """The film of a driving episode.

    Args:
        episode: the episode.
    """

    def __init__(self, episode: Episode) -> None:
        self.episode, self.fps = episode, episode.facts.decision_hz
        self.has_road = episode.on_road
        self.plan = Plan(episode) if episode.facts.lanes and self.has_road else None
        self.stands = self.plan is not None and self.plan.bends
        if self.has_road:
            self.low, self.high = (-HIGH / 2, HIGH / 2) if self.stands else edges(episode)
        self.road_top = HEADER
        self.road_height = round((self.high - self.low) * SCALE) if self.has_road else 0
        self.bands_top = self.road_top + (self.road_height + MARGIN + KEY if self.has_road else 0)
        self.bands = self._bands()
        self.legend_top = self.bands_top + MARGIN + len(self.bands) * (BAND + 4)
        self.plots_top = self.legend_top + (LEGEND if self.bands else VALUES)
        self.plots = self._plots()
        self.height = self.plots_top + (PLOT + MARGIN) * len(self.plots)

    def __len__(self) -> int:
        return len(self.episode)

    def pictures(self, steps: int) -> Iterator[Picture]:
        empty, full = self._sheet(steps, drawn=False), self._sheet(steps, drawn=True)
        picture = empty
        for step in range(steps):
            if step < len(self):
                now = self._place(step + 1, steps)
                picture = empty.copy()
                picture[self.bands_top :, LEFT : round(now)] = full[self.bands_top :, LEFT : round(now)]
                line(picture, (now, self.bands_top + MARGIN), (now, self.height - MARGIN), BLACK)
                self._write_values(picture, step)
                if self.has_road:
                    self._road(picture, step)
            yield picture

    def _place(self, step: float, steps: int) -> float:
        return LEFT + (RIGHT - LEFT) * step / steps

    def _sheet(self, steps: int, *, drawn: bool) -> Picture:
        """What does not change: title, labels, axes and, if `drawn`, the whole bands and curves."""
        sheet = blank(self.height, WIDTH)
        write(sheet, about.title(self.episode.meta), 12, HEADER / 2, size=18)
        if self.has_road:
            self._write_key(sheet)
        for number, (label, values) in enumerate(self.bands.items()):
            top = self.bands_top + MARGIN + number * (BAND + 4)
            write(sheet, label, 12, top + BAND / 2, size=14, colour=BLACK)
            sheet[top : top + BAND, LEFT:RIGHT] = ROAD
            if drawn:
                for step, value in enumerate(values):
                    here, after = (round(self._place(place, steps)) for place in (step, step + 1))
                    sheet[top : top + BAND, here:after] = self._colours()[int(value)]
        if self.bands:
            self._write_legend(sheet)
        for number, (_, moved, budget) in enumerate(self.plots):
            top = self.plots_top + number * (PLOT + MARGIN)
            line(sheet, (LEFT, top + PLOT), (RIGHT, top + PLOT), PALE)
            if drawn:
                self._curve(sheet, top, moved, budget, steps)
        return sheet

    def _write_key(self, sheet: Picture) -> None:
        """What the boxes on the road are."""
        y = self.bands_top - KEY / 2 + 3
        keys: list[tuple[str, Colour, float]] = [("driven by the policy", GREEN, 0), ("other cars", SKY, 0)]
        if self.episode.attacked:
            keys.append(("what the attack shows the policy", VERMILLION, 2))
        x = 12.0
        for text, colour, outline in keys:
            box(sheet, x + 12, y, (10, 4), colour, outline)
            write(sheet, text, x + 30, y, size=13, colour=GREY)
            x += 60 + 6.6 * len(text)

    def _bands(self) -> dict[str, NDArray[np.generic]]:
        if not self.episode.discrete:
            return {}
        clean, taken = self.episode.choices
        if not self.episode.attacked:
            return {"decision": taken}
        return {"without the attack": clean, "taken": taken}

    def _colours(self) -> list[Colour]:
        return list(islice(cycle(CYCLE), len(self.episode.facts.actions)))

    def _write_legend(self, sheet: Picture) -> None:
        names = [name.replace("_", " ").lower() for name in self.episode.facts.actions]
        for number, (name, colour) in enumerate(zip(names, self._colours(), strict=True)):
            x, y = LEFT + number * (RIGHT - LEFT) / len(names), self.legend_top + LEGEND / 2 - 4
            box(sheet, x + 6, y, (6, 6), colour)
            write(sheet, name, x + 18, y, size=13, colour=GREY)

    def _plots(self) -> list[tuple[str, Array, Array]]:
        """For each unit: its name, the largest perturbation [T] of all features with that unit, and its budget [T]."""
        episode = self.episode
        if not episode.attacked:
            return []
        found: dict[str, tuple[Array, Array]] = {}
        for name, unit in zip(episode.features.names, episode.features.units, strict=True):
            moved, budget = episode.moved(name), episode.budget[name]
            known = found.get(unit, (np.zeros_like(moved), np.zeros_like(budget)))
            found[unit] = (np.maximum(known[0], moved), np.maximum(known[1], budget))
        return [(unit, *values) for unit, values in found.items()]

    def _curve(self, sheet: Picture, top: int, moved: Array, budget: Array, steps: int) -> None:
        """The perturbation as an area, and its budget as a line above."""
        highest = max(float(budget.max()), float(moved.max()), 1e-9)
        places = [self._place(step + 0.5, steps) for step in range(len(moved))]
        for step, value in enumerate(moved):
            here, after = (round(self._place(place, steps)) for place in (step, step + 1))
            sheet[top + PLOT - round(PLOT * value / highest) : top + PLOT, here : max(after, here + 1)] = TINT
        heights = top + PLOT - PLOT * budget / highest
        for (x, y), (x2, y2) in zip(
            zip(places, heights, strict=True), zip(places[1:], heights[1:], strict=True), strict=False
        ):
            line(sheet, (x, y), (x2, y2), BLACK)

    def _write_values(self, picture: Picture, step: int) -> None:
        episode = self.episode
        speed = float(episode.steps["speed"][step])
        status, colour = f"{(step + 1) / self.fps:.1f} s", BLACK
        if self.has_road:
            status = f"{speed:.0f} m/s     {status}"
        if step == len(episode) - 1:
            ended = episode.end
            colour = BLACK if ended == "drove to the end" else VERMILLION
            status = f"{ended}     {status}"
        write(picture, status, WIDTH - 16, HEADER / 2, size=18, colour=colour, align="right")
        for number, (unit, moved, budget) in enumerate(self.plots):
            top = self.plots_top + number * (PLOT + MARGIN)
            write(picture, "perturbation", 12, top + 14, size=14)
            write(picture, f"{moved[step]:.1f} of {budget[step]:.1f} {unit}", 12, top + 36, size=16, colour=BLACK)
        if not episode.discrete:
            _, taken = episode.choices
            words = [f"{name} {value:+.2f}" for name, value in zip(episode.facts.controls, taken[step], strict=True)]
            write(picture, "     ".join(words), 12, self.bands_top + 12, size=14, colour=GREY)

    def _road(self, picture: Picture, step: int) -> None:
        road = picture[self.road_top : self.road_top + self.road_height]
        road[:] = ROAD
        if self.plan is not None:
            self._network(road, self.plan, step)
            self._cars(road, step)
            return
        x = float(self.episode.steps["x"][step])
        first = -BEHIND - (x - BEHIND) % DASH_EVERY
        for y in np.arange(self.low + LANE_WIDTH, self.high - 0.1, LANE_WIDTH):
            for start in np.arange(first, AHEAD, DASH_EVERY):
                line(road, (*self._pixel(start, y),), (*self._pixel(start + DASH, y),), GREY)
        for y in (0, len(road) - 2):
            road[y : y + 2] = GREY
        self._cars(road, step)

    def _network(self, road: Picture, plan: Plan, step: int) -> None:
        """The lanes around the ego: asphalt over wider strips of paint, on grass."""
        road[:] = GRASS
        x, y = plan.ego[step]
        around = (BEHIND + AHEAD) / 2 if self.stands else AHEAD
        lanes = plan.near(float(x), around, around)
        for colour, off in ((GREY, 0.3), (ROAD, -0.3)):
            for width, points in lanes:
                places = [self._pixel(*point) for point in points - [0.0, y if self.stands else 0.0]]
                stroke(road, places, colour, round((width + off) * SCALE))

    def _pixel(self, x: float, y: float) -> tuple[float, float]:
        """The place on the road's picture of a place in metres, x from the ego, and y too where the picture goes with it."""
        before = (BEHIND + AHEAD) / 2 if self.stands else BEHIND
        return (x + before) * SCALE, (y - self.low) * SCALE

    @cached_property
    def _towards(self) -> Array:
        """[T, V, 2] where the cars look."""
        if self.plan is not None and self.stands:
            return self.plan.directions()
        shape = self.episode.physical("observation", "x").shape
        return np.broadcast_to(np.array([1.0, 0.0]), (*shape, 2))

    def _cars(self, road: Picture, step: int) -> None:
        episode = self.episode
        half = (CAR_LENGTH / 2 * SCALE, CAR_WIDTH / 2 * SCALE)
        ego = 0.0 if self.stands else float(episode.physical("observation", "y")[step, 0])
        own, others = self._towards[step, 0], self._towards[step, 1:][episode.present[step]]
        present = episode.present[step]
        places = {
            name: np.stack([episode.physical(name, axis)[step, 1:][present] for axis in ("x", "y")], -1)
            for name in ("observation", "perturbed")
        }
        for (x, y), towards in zip(places["observation"], others, strict=True):
            box(road, *self._pixel(x, y + ego), half, SKY, towards=towards)
            box(road, *self._pixel(x, y + ego), half, BLUE, 1, towards=towards)
        crashed = bool(episode.steps["crashed"][step])
        box(road, *self._pixel(0, ego), half, VERMILLION if crashed else GREEN, towards=own)
        box(road, *self._pixel(0, ego), half, BLACK, 2 if crashed else 1, towards=own)
        if episode.attacked:
            self._ghosts(road, step, places, ego, half)
        if crashed:
            x, y = self._pixel(0, ego)
            write(road, "CRASH", x - half[0] - 8, y, size=22, colour=VERMILLION, align="right")

    def _ghosts(
        self, road: Picture, step: int, places: dict[str, Array], ego: float, half: tuple[float, float]
    ) -> None:
        """What the attack shows, and how far it is from the truth."""
        others = self._towards[step, 1:][self.episode.present[step]]
        for number, ((x, y), (x2, y2)) in enumerate(zip(places["observation"], places["perturbed"], strict=True)):
            line(road, self._pixel(x, y + ego), self._pixel(x2, y2 + ego), VERMILLION, 1)
            box(road, *self._pixel(x2, y2 + ego), half, VERMILLION, 2, towards=others[number])
        x, y = (
            float(
                self.episode.physical("perturbed", axis)[step, 0] - self.episode.physical("observation", axis)[step, 0]
            )
            for axis in "xy"
        )
        box(road, *self._pixel(x if self.stands else 0, ego + y), half, VERMILLION, 2, towards=self._towards[step, 0])
