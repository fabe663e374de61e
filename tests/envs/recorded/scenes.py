"""Writes small scenes in CommonRoad's XML: parallel lanes on a straight or round road, and cars that were never recorded."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
STEP_S = 0.1


@dataclass(frozen=True, kw_only=True)
class Car:
    """A car on a lane: its place along it in m at each time step from `first` on."""

    number: int
    lane: int
    along: Sequence[float]
    first: int = 0
    length: float = 4.5
    width: float = 1.8
    kind: str = "car"


def wave(start: float, speed: float, *, steps: int, braking: float = 0.0) -> list[float]:
    """Places in m of a car that keeps its speed for two seconds, then brakes at so many m/s2 down to half of it."""
    times = np.arange(steps) * STEP_S
    speeds = np.maximum(speed - braking * np.maximum(times - 2.0, 0), speed / 2)
    return [float(place) for place in start + np.append(0.0, np.cumsum(speeds[:-1] * STEP_S))]


def platoon(*, steps: int = 101, lanes: int = 3, gap: float = 30.0, speed: float = 14.0) -> list[Car]:
    """Cars on all lanes that brake one after the other."""
    cars = []
    for lane in range(lanes):
        for place in range(5):
            along = wave(20.0 + gap * place + 7 * lane, speed, steps=steps, braking=1.5 + 0.2 * place)
            cars.append(Car(number=100 + 10 * lane + place, lane=lane, along=along))
    return cars


@dataclass(frozen=True, kw_only=True)
class Road:
    """Parallel lanes, numbered from the left.

    Args:
        lanes, width, length: how many, and their sizes in m.
        radius: of a bend to the left in m; inf for a straight road.
        heading, x, y: where the left border begins, and in which direction.
        pieces: lanelets of each lane.
    """

    lanes: int = 3
    width: float = 3.5
    length: float = 300.0
    radius: float = math.inf
    heading: float = 0.6
    x: float = 0.0
    y: float = 0.0
    pieces: int = 3

    def place(self, along: float, across: float) -> tuple[float, float, float]:
        """x, y and heading, so many m along the left border and to its right."""
        if math.isinf(self.radius):
            x, y, turned = along, -across, 0.0
        else:
            turned = along / self.radius
            x, y = (self.radius + across) * math.sin(turned), self.radius - (self.radius + across) * math.cos(turned)
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        return self.x + cos * x - sin * y, self.y + sin * x + cos * y, self.heading + turned

    def number(self, lane: int, piece: int) -> int:
        """The id of a lanelet."""
        return 1 + lane * self.pieces + piece


def scene(
    road: Road | None = None,
    cars: Sequence[Car] | None = None,
    *,
    version: str = "2020a",
    problem: bool = True,
    edit: Callable[[str], str] = str,
) -> str:
    """The text of a scene; `edit` may change it."""
    road = Road() if road is None else road
    cars = platoon(lanes=road.lanes) if cars is None else cars
    parts = [f'<?xml version="1.0"?>\n<commonRoad commonRoadVersion="{version}" timeStepSize="{STEP_S}">']
    parts += [_lanelet(road, lane, piece) for lane in range(road.lanes) for piece in range(road.pieces)]
    parts += [_obstacle(road, car, version) for car in cars]
    if problem:
        middle = (road.lanes // 2 + 0.5) * road.width
        parts.append(f'<planningProblem id="9999"><initialState>{_state(*road.place(30.0, middle), 12.0, 0)}')
        parts.append("</initialState></planningProblem>")
    return edit("\n".join([*parts, "</commonRoad>\n"]))


def with_static(text: str, road: Road, along: float, lane: int) -> str:
    """A scene with a parked car, on a version of 2020a."""
    where = road.place(along, (lane + 0.5) * road.width)
    parked = (
        '<staticObstacle id="777"><type>parkedVehicle</type><shape><rectangle><length>4.0</length><width>1.8</width>'
        f"</rectangle></shape><initialState>{_state(*where, 0.0, 0)}</initialState></staticObstacle>"
    )
    return text.replace("</commonRoad>", parked + "</commonRoad>")


def _lanelet(road: Road, lane: int, piece: int) -> str:
    ends = np.linspace(0, road.length, road.pieces + 1)
    alongs = np.linspace(ends[piece], ends[piece + 1], 13)
    parts = [f'<lanelet id="{road.number(lane, piece)}">']
    for tag, across in (("leftBound", lane * road.width), ("rightBound", (lane + 1) * road.width)):
        points = [_point(*road.place(along, across)[:2]) for along in alongs]
        parts += [f"<{tag}>", *points, f"</{tag}>"]
    if piece:
        parts.append(f'<predecessor ref="{road.number(lane, piece - 1)}"/>')
    if piece < road.pieces - 1:
        parts.append(f'<successor ref="{road.number(lane, piece + 1)}"/>')
    if lane:
        parts.append(f'<adjacentLeft ref="{road.number(lane - 1, piece)}" drivingDir="same"/>')
    if lane < road.lanes - 1:
        parts.append(f'<adjacentRight ref="{road.number(lane + 1, piece)}" drivingDir="same"/>')
    return "\n".join([*parts, "<laneletType>highway</laneletType></lanelet>"])


def _point(x: float, y: float) -> str:
    return f"<point><x>{float(x)!r}</x><y>{float(y)!r}</y></point>"


def _state(x: float, y: float, heading: float, speed: float, step: int) -> str:
    return (
        f"<position>{_point(x, y)}</position><orientation><exact>{float(heading)!r}</exact></orientation>"
        f"<time><exact>{step}</exact></time><velocity><exact>{speed!r}</exact></velocity>"
    )


def _obstacle(road: Road, car: Car, version: str) -> str:
    across = (car.lane + 0.5) * road.width
    speeds = np.append(np.diff(car.along), 0.0) / STEP_S if len(car.along) > 1 else np.zeros(1)
    speeds[-1] = speeds[-2] if len(speeds) > 1 else 0.0
    states = [
        _state(*road.place(along, across), float(speed), car.first + step)
        for step, (along, speed) in enumerate(zip(car.along, speeds, strict=True))
    ]
    old = version == "2018b"
    head = f'<obstacle id="{car.number}"><role>dynamic</role>' if old else f'<dynamicObstacle id="{car.number}">'
    return "\n".join(
        [
            head,
            f"<type>{car.kind}</type><shape><rectangle><length>{car.length}</length><width>{car.width}</width></rectangle></shape>",
            f"<initialState>{states[0]}</initialState>",
            "<trajectory>",
            *(f"<state>{state}</state>" for state in states[1:]),
            "</trajectory>",
            "</obstacle>" if old else "</dynamicObstacle>",
        ]
    )


def moved(road: Road, *, heading: float, x: float, y: float) -> Road:
    """The same road elsewhere."""
    return replace(road, heading=heading, x=x, y=y)
