"""The sets of the threat model beside lies about values: one scenario under each of them, from above."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cavbench.driving.surroundings import Surroundings
from cavbench.envs.highway.axes import AXES
from cavbench.envs.highway.config import HighwayConfig
from cavbench.envs.highway.ego import IDLE, LANE_LEFT, SLOWER
from cavbench.envs.highway.engine import HighwayEngine
from cavbench.scenarios import SeedBlock
from docs.figures import road, style

Cars = NDArray[np.void]

LANES, HZ = 3, 15
CONFIG = HighwayConfig(cells=(AXES.cell(lanes=LANES, density=1.0),), driver="idm")
BEGIN = 75
"""The moment: 5 s into the scenario."""
REACH = (-20.0, 90.0)


def presence() -> Figure:
    """A car that is hidden, and one that is invented."""
    made, axes = _figure()
    now = _history()[BEGIN]
    hidden = _nearest_ahead(now)
    seen = [number for number in range(1, len(now)) if number != hidden]
    road.cars(axes, _places(now, seen), style.BLUE)
    road.cars(axes, _places(now, [hidden]), style.GREY, filled=False)
    road.cars(axes, [(0.0, float(now["y"][0]))], style.ORANGE)
    road.cars(axes, [(25.0, float(now["y"][0]))], style.RED)
    return made


def latency() -> Figure:
    """Where the cars are, and where the frame of a second ago has them."""
    made, axes = _figure()
    _now_and_shown(axes, BEGIN, BEGIN - HZ)
    return made


def held() -> Figure:
    """A frame that is shown for two seconds."""
    made = Figure(figsize=(style.WIDTH, 2.1), layout="constrained")
    for axes, later in zip(made.subplots(2, 1, sharex=True), (0, 2 * HZ), strict=True):
        _road(axes)
        _now_and_shown(axes, BEGIN + later, BEGIN)
    return made


def actuator() -> Figure:
    """A change of lane that is executed at once, and 0.8 s late."""
    made, axes = _figure()
    _courses(axes, [[LANE_LEFT], [*[IDLE] * 12, LANE_LEFT]], [CONFIG.surroundings] * 2, seconds=3)
    return made


def dynamics() -> Figure:
    """Braking on a dry road and on a slippery one."""
    made, axes = _figure()
    _courses(axes, [[SLOWER] * 45] * 2, [Surroundings(), Surroundings(friction=0.2)], seconds=3)
    return made


@cache
def _history() -> list[Cars]:
    """The cars [N] of each decision, while IDM is at the wheel."""
    engine = HighwayEngine(CONFIG)
    engine.reset(np.arange(1), np.array([SeedBlock.REPORT]))
    found = []
    for _ in range(BEGIN + 3 * HZ):
        found.append(engine.vehicles[0].copy())
        engine.step(np.ones(1, np.int64))
    return found


def _figure() -> tuple[Figure, Axes]:
    made = Figure(figsize=(style.WIDTH, 1.2), layout="constrained")
    axes = made.subplots()
    _road(axes)
    return made, axes


def _road(axes: Axes) -> None:
    road.lanes(axes, LANES, REACH)


def _places(cars: Cars, numbers: Sequence[int]) -> list[road.Place]:
    """Places relative to the victim along the road."""
    found = [(float(cars["x"][n] - cars["x"][0]), float(cars["y"][n])) for n in numbers]
    return [(x, y) for x, y in found if REACH[0] <= x <= REACH[1]]


def _nearest_ahead(cars: Cars) -> int:
    ahead = cars["x"] - cars["x"][0]
    return int(np.where(ahead > 0, ahead, np.inf).argmin())


def _now_and_shown(axes: Axes, now: int, shown: int) -> None:
    """Where the cars are (blue), and where an older frame has them (red outlines)."""
    everyone = range(1, CONFIG.vehicles + 1)
    road.cars(axes, _places(_history()[now], everyone), style.BLUE)
    road.cars(axes, _places(_history()[shown], everyone), style.RED, filled=False)
    road.cars(axes, [(0.0, float(_history()[now]["y"][0]))], style.ORANGE)


def _courses(axes: Axes, plans: Sequence[Sequence[int]], around: Sequence[Surroundings], *, seconds: int) -> None:
    """The victim's course under two lists of actions, then IDLE: the second one is red; a car each second."""
    start = _history()[BEGIN]
    for plan, surroundings, colour in zip(plans, around, (style.ORANGE, style.RED), strict=True):
        engine = _begun(surroundings)
        course = [(0.0, float(start["y"][0]))]
        for step in range(seconds * HZ):
            engine.step(np.array([plan[step] if step < len(plan) else IDLE]))
            ego: Any = engine.vehicles[0, 0]
            course.append((float(ego["x"] - start["x"][0]), float(ego["y"])))
        axes.plot(*zip(*course, strict=True), color=colour, lw=1.4)
        road.cars(axes, course[::HZ], colour, filled=colour == style.ORANGE)


def _begun(surroundings: Surroundings) -> HighwayEngine:
    """The scenario at the moment, with a victim that takes actions."""
    engine = HighwayEngine(replace(CONFIG, driver="agent", surroundings=surroundings))
    engine.reset(np.arange(1), np.array([SeedBlock.REPORT]))
    engine.vehicles[0] = _history()[BEGIN]
    engine.order[0] = np.argsort(engine.vehicles[0]["x"])
    engine.vehicles[0]["target_speed"][0] = 25.0
    return engine
