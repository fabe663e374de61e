"""Cars, vans and lorries as lofted bodies, at the origin with the rear towards -y."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.interpolate import PchipInterpolator

from cavbench.envs.camera.street import material as m
from cavbench.envs.camera.street.material import Material
from cavbench.envs.camera.street.mesh import Mesh, block, join, quad, sweep

Part = tuple[Mesh, Material]
Model = Literal["saloon", "hatchback", "van", "lorry"]

PAINTS = (
    (0.03, 0.03, 0.035),
    (0.55, 0.55, 0.56),
    (0.75, 0.75, 0.74),
    (0.05, 0.09, 0.22),
    (0.28, 0.02, 0.025),
    (0.18, 0.19, 0.2),
    (0.04, 0.12, 0.08),
    (0.35, 0.3, 0.22),
)
"""Paint colours as linear reflectances."""


@dataclass(frozen=True)
class Shape:
    """Cross sections of a vehicle from rear to front: y, lower edge, upper edge and half width, in m."""

    body: tuple[tuple[float, float, float, float], ...]
    cabin: tuple[tuple[float, float, float, float], ...] = ()
    wheels: tuple[float, float] = (-1.35, 1.4)
    wheel_radius: float = 0.33
    track: float = 0.78


SHAPES: dict[Model, Shape] = {
    "saloon": Shape(
        body=(
            (-2.32, 0.42, 0.8, 0.7),
            (-2.25, 0.33, 0.96, 0.84),
            (-1.6, 0.26, 1.0, 0.9),
            (0.0, 0.24, 0.97, 0.92),
            (1.2, 0.26, 0.93, 0.9),
            (2.0, 0.3, 0.78, 0.84),
            (2.3, 0.4, 0.62, 0.66),
        ),
        cabin=((-1.85, 0.94, 1.0, 0.72), (-1.15, 0.94, 1.4, 0.66), (0.2, 0.94, 1.45, 0.66), (1.25, 0.9, 0.97, 0.74)),
    ),
    "hatchback": Shape(
        body=(
            (-1.95, 0.42, 0.86, 0.72),
            (-1.88, 0.32, 1.0, 0.84),
            (-1.2, 0.26, 1.0, 0.88),
            (0.6, 0.25, 0.98, 0.88),
            (1.5, 0.3, 0.86, 0.82),
            (1.95, 0.4, 0.66, 0.66),
        ),
        cabin=((-1.9, 0.96, 1.06, 0.74), (-1.55, 0.96, 1.48, 0.66), (0.1, 0.96, 1.52, 0.66), (1.15, 0.94, 1.0, 0.74)),
        wheels=(-1.2, 1.25),
    ),
    "van": Shape(
        body=(
            (-2.7, 0.4, 2.45, 0.93),
            (-2.62, 0.35, 2.6, 0.98),
            (1.2, 0.35, 2.62, 0.98),
            (1.75, 0.35, 1.9, 0.96),
            (2.3, 0.38, 1.25, 0.92),
            (2.75, 0.45, 0.95, 0.8),
        ),
        wheels=(-1.7, 1.75),
        wheel_radius=0.36,
        track=0.86,
    ),
    "lorry": Shape(
        body=((-4.2, 1.0, 3.5, 1.24), (-4.15, 1.0, 3.55, 1.25), (2.3, 1.0, 3.55, 1.25), (2.35, 1.0, 3.5, 1.24)),
        cabin=((2.5, 0.5, 2.6, 1.15), (2.55, 0.45, 2.9, 1.18), (3.7, 0.45, 2.9, 1.18), (4.2, 0.5, 2.2, 1.12)),
        wheels=(-2.6, 3.2),
        wheel_radius=0.5,
        track=1.0,
    ),
}
LENGTH = {model: shape.body[-1][0] - shape.body[0][0] for model, shape in SHAPES.items()}
SHARES = (0.35, 0.3, 0.2, 0.15)
"""Shares of the models in traffic, in the order of `Model`."""


def footprint(model: Model) -> tuple[float, float, float]:
    """Rear end, front end and half the width of a vehicle at the origin, in m."""
    stations = SHAPES[model].body + SHAPES[model].cabin
    return min(s[0] for s in stations), max(s[0] for s in stations), max(s[3] for s in stations)


def vehicle(model: Model, paint: tuple[float, float, float], *, lights: bool = False) -> list[Part]:
    """The parts of a vehicle.

    Args:
        model: kind of vehicle.
        paint: linear reflectance.
        lights: whether the tail lights are on.
    """
    shape = SHAPES[model]
    coat = Material("paint", paint)
    parts: list[Part] = [(_loft(shape.body), coat if model != "lorry" else Material("matt", (0.62, 0.62, 0.6)))]
    if model == "lorry":
        parts += [(_loft(shape.cabin), coat), (block(-1.1, 1.1, -4.0, 4.0, 0.55, 1.0), m.RUBBER)]
    elif shape.cabin:
        parts += [(_loft(shape.cabin), m.GLASS), (_roof(shape), coat)]
    if model == "van":
        rear = shape.body[0][0] - 0.02
        parts.append((join([_panel(-0.7, -0.05, 1.5, 2.2, rear), _panel(0.05, 0.7, 1.5, 2.2, rear)]), m.GLASS))
    parts.append((join([_wheel(shape, x, y) for x in (-1, 1) for y in shape.wheels]), m.RUBBER))
    parts.append((join([_hub(shape, x, y) for x in (-1, 1) for y in shape.wheels]), m.CHROME))
    rear = min(station[0] for station in shape.body) - 0.015
    low, high = (0.7, 0.88) if shape.cabin and model != "lorry" else (0.75, 1.15)
    wide = shape.body[0][3]
    lamps = join([_panel(x, x + 0.17, low, high, rear) for x in (-wide, wide - 0.17)])
    parts.append((lamps, m.TAIL_LIGHT_LIT if lights else m.TAIL_LIGHT))
    parts.append((_panel(-0.26, 0.26, 0.55, 0.66, rear), m.PLATE))
    return parts


def _loft(stations: tuple[tuple[float, float, float, float], ...], around: int = 32, rings: int = 40) -> Mesh:
    """A smooth surface of rounded rectangles through the stations."""
    given = np.array(stations)
    between = np.interp(np.linspace(0, len(given) - 1, rings), np.arange(len(given)), given[:, 0])
    lengthwise = PchipInterpolator(given[:, 0], given[:, 1:])(between)
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    # A superellipse: nearly a rectangle, but without edges.
    cos, sin = np.cos(angle), np.sin(angle)
    across, up = np.sign(cos) * np.abs(cos) ** 0.45, np.sign(sin) * np.abs(sin) ** 0.45
    skin = [
        np.stack([half * across, np.full(around, y), (low + high) / 2 + (high - low) / 2 * up], 1)
        for y, (low, high, half) in zip(between, lengthwise, strict=True)
    ]
    return sweep(np.stack(skin))


def _roof(shape: Shape) -> Mesh:
    """The painted roof above the glass: slightly above the cabin between its middle stations."""
    (y0, _, z0, w0), (y1, _, z1, w1) = shape.cabin[1:3]
    stations = (
        (y0 - 0.1, z0 - 0.07, z0 + 0.0, 0.86 * w0),
        (y0 + 0.1, z0 - 0.07, z0 + 0.035, 0.97 * w0),
        ((y0 + y1) / 2, z0 - 0.07, (z0 + z1) / 2 + 0.045, w0),
        (y1, z1 - 0.07, z1 + 0.03, 0.97 * w1),
        (y1 + 0.12, z1 - 0.07, z1 - 0.01, 0.86 * w1),
    )
    return _loft(stations)


def _panel(x0: float, x1: float, z0: float, z1: float, y: float) -> Mesh:
    """A rectangle that faces -y."""
    return quad([(x0, y, z0), (x1, y, z0), (x1, y, z1), (x0, y, z1)])


def _disc(x0: float, x1: float, y: float, radius: float, middle: float, sides: int = 24) -> Mesh:
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    circle = np.stack([y + radius * np.cos(angle), middle + radius * np.sin(angle)], 1)
    return sweep(np.stack([np.column_stack([np.full(sides, x), circle]) for x in (x0, x1)]))


def _wheel(shape: Shape, side: int, y: float) -> Mesh:
    return _disc(side * (shape.track - 0.1), side * (shape.track + 0.12), y, shape.wheel_radius, shape.wheel_radius)


def _hub(shape: Shape, side: int, y: float) -> Mesh:
    outside = shape.track + 0.125
    return _disc(side * (outside - 0.02), side * outside, y, 0.62 * shape.wheel_radius, shape.wheel_radius)
