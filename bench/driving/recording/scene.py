"""The road from above in metres, moving with the ego: measured cars, and cars in the attacked observation."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from cavbench.driving.recording.episode import Array, Episode
from cavbench.driving.recording.plan import Plan
from cavbench.recording.colours import EGO, MEASURED, SHOWN, Colour
from cavbench.recording.columns import Columns

LANE_WIDTH, CAR_LENGTH, CAR_WIDTH = 4.0, 5.0, 2.0
"""As in highway-env (road/lane.py, vehicle/kinematics.py). Lane 0 is centred on y = 0; y grows to the right."""
BEHIND, AHEAD = 60.0, 140.0
"""Length of the road drawn behind and ahead of the ego, in m."""
DASH, DASH_EVERY = 3.0, 9.0

ASPHALT: Colour = (46, 48, 54)
PAINT: Colour = (150, 152, 158)
CRASHED: Colour = (247, 84, 92)
LAYERS = (("road/edges", PAINT, 0.1, 0.0), ("road/surface", ASPHALT, -0.1, 1.0))
"""Path, colour, metres beside the lane, and order of what a network of lanes is drawn with."""


def log(episode: Episode, columns: Columns) -> None:
    """Send the road and the cars, if the observation has positions."""
    if not episode.on_road:
        return
    _road(episode, columns)
    _cars(episode, columns)


def bounds(episode: Episode) -> tuple[tuple[float, float], tuple[float, float]]:
    """Initial x and y range of the view, in m."""
    plan = Plan(episode) if episode.facts.lanes else None
    if plan is not None and plan.bends:
        low, high = plan.bounds
        return (low[0] - 5, high[0] + 5), (low[1] - 5, high[1] + 5)
    first, last = edges(episode)
    return (-45.0, 105.0), (first - 2.5, last + 2.5)


def edges(episode: Episode) -> tuple[float, float]:
    """y of the left and right edge of the road, in m."""
    if episode.facts.lanes:
        lowest, highest = Plan(episode).bounds
        return float(lowest[1]), float(highest[1])
    lanes = json.loads(str(episode.meta.get("cell", "{}"))).get("lanes")
    if lanes is None:
        ego = episode.physical("observation", "y")[:, 0]
        lanes = max(1, round(float(ego.max()) / LANE_WIDTH) + 1)
    return -LANE_WIDTH / 2, (int(str(lanes)) - 0.5) * LANE_WIDTH


def _network(plan: Plan, episode: Episode, columns: Columns) -> None:
    """The lanes: asphalt over wider strips of paint, so that lanes beside each other have a line between them."""
    if plan.bends:
        for path, colour, off, order in LAYERS:
            drawn = rr.LineStrips2D(plan.lines, radii=plan.widths / 2 + off, colors=[colour], draw_order=order)
            columns.fixed(path, drawn)
        return
    steps = [plan.near(float(x), BEHIND, AHEAD) for x in plan.ego[:, 0]]
    counts = np.array([len(lanes) for lanes in steps])
    strips = [line for lanes in steps for _, line in lanes]
    widths = np.array([width for lanes in steps for width, _ in lanes])
    for path, colour, off, order in LAYERS:
        columns.fixed(path, rr.LineStrips2D.from_fields(colors=[colour], draw_order=order))
        columns.send(path, rr.LineStrips2D.columns(strips=strips, radii=widths / 2 + off).partition(counts))


def _road(episode: Episode, columns: Columns) -> None:
    if episode.facts.lanes:
        _network(Plan(episode), episode, columns)
        return
    low, high = edges(episode)
    middle = (low + high) / 2
    surface = [[-BEHIND, middle], [AHEAD, middle]]
    columns.fixed(
        "road/surface", rr.LineStrips2D([surface], radii=[(high - low) / 2], colors=[ASPHALT], draw_order=0.0)
    )
    sides = [[[-BEHIND, y], [AHEAD, y]] for y in (low, high)]
    columns.fixed("road/edges", rr.LineStrips2D(sides, radii=[0.12], colors=[PAINT], draw_order=1.0))
    between = np.arange(low + LANE_WIDTH, high - 0.1, LANE_WIDTH)
    if not len(between):
        return
    # Dashes are fixed to the road, while the view moves with the ego.
    x = np.asarray(episode.steps["x"], dtype=np.float64)
    first = -BEHIND - np.mod(x - BEHIND, DASH_EVERY) + DASH_EVERY
    starts = first[:, None, None] + np.arange(int((AHEAD + BEHIND) / DASH_EVERY) - 1)[None, None, :] * DASH_EVERY
    starts, y = np.broadcast_arrays(starts, between[None, :, None])
    ends = np.stack([np.stack([starts, y], -1), np.stack([starts + DASH, y], -1)], -2)
    strips = ends.reshape(-1, 2, 2)
    columns.fixed("road/dashes", rr.LineStrips2D.from_fields(radii=[0.1], colors=[PAINT], draw_order=1.0))
    columns.send(
        "road/dashes", rr.LineStrips2D.columns(strips=strips).partition(np.full(len(x), len(strips) // len(x)))
    )


@dataclass(frozen=True)
class _Cars:
    """Centres of vehicles and where they look, of all steps in sequence, and their number in each step."""

    centres: Array
    lengths: NDArray[np.int64]
    towards: Array


@dataclass(frozen=True)
class _Placed:
    """Where the ego of an episode is in the picture, [T, 2], where all cars look, [T, V, 2], and whether the picture stands."""

    ego: Array
    towards: Array
    stands: bool

    @classmethod
    def of(cls, episode: Episode) -> _Placed:
        """On a road along x the picture moves with the ego, and every car looks along it."""
        plan = Plan(episode) if episode.facts.lanes else None
        y = episode.physical("observation", "y")
        if plan is not None and plan.bends:
            return cls(plan.ego, plan.directions(), True)
        return cls(np.stack([np.zeros(len(y)), y[:, 0]], -1), np.broadcast_to([1.0, 0.0], (*y.shape, 2)), False)


def _others(episode: Episode, name: str, placed: _Placed) -> _Cars:
    """Positions of the other vehicles in `observation` or `perturbed`, relative to the ego's true position."""
    centres = np.stack([episode.physical(name, feature)[:, 1:] for feature in ("x", "y")], -1) + placed.ego[:, None]
    present = episode.present
    return _Cars(centres[present], present.sum(1), placed.towards[:, 1:][present])


def _cars(episode: Episode, columns: Columns) -> None:
    placed = _Placed.of(episode)
    traffic = _others(episode, "observation", placed)
    _bodies(columns, "traffic/measured", traffic, MEASURED)
    one = np.ones(len(episode), np.int64)
    crashed = np.asarray(episode.steps["crashed"], dtype=bool)
    _bodies(
        columns,
        "ego/measured",
        _Cars(placed.ego, one, placed.towards[:, 0]),
        EGO,
        np.where(crashed[:, None], CRASHED, EGO),
    )
    if episode.attacked:
        shown = _others(episode, "perturbed", placed)
        _ghosts(columns, "traffic/shown", shown)
        moved = [
            episode.physical("perturbed", axis)[:, 0] - episode.physical("observation", axis)[:, 0] for axis in "xy"
        ]
        ghost = placed.ego + np.stack([moved[0] * placed.stands, moved[1]], -1)
        _ghosts(columns, "ego/shown", _Cars(ghost, one, placed.towards[:, 0]))
        columns.fixed("traffic/moved", rr.Arrows2D.from_fields(radii=[0.12], colors=[SHOWN], draw_order=4.0))
        vectors = rr.Arrows2D.columns(vectors=shown.centres - traffic.centres, origins=traffic.centres)
        columns.send("traffic/moved", vectors.partition(traffic.lengths))


def _bodies(
    columns: Columns, path: str, cars: _Cars, colour: Colour, colours: NDArray[np.generic] | None = None
) -> None:
    """Send filled cars as thick lines (rerun draws only outlines of boxes); `colours`: one for each car, if they differ."""
    half = (CAR_LENGTH - CAR_WIDTH) / 2 * cars.towards
    strips = np.stack([cars.centres - half, cars.centres + half], 1)
    per_car = np.broadcast_to(colour, (len(strips), 3)) if colours is None else colours
    columns.fixed(path, rr.LineStrips2D.from_fields(radii=[CAR_WIDTH / 2], draw_order=2.0))
    columns.send(path, rr.LineStrips2D.columns(strips=strips, colors=per_car.astype(np.uint8)).partition(cars.lengths))


def _ghosts(columns: Columns, path: str, cars: _Cars) -> None:
    """Send outlines of the cars in the attacked observation."""
    columns.fixed(path, rr.LineStrips2D.from_fields(radii=[0.15], colors=[SHOWN], draw_order=3.0))
    columns.send(path, rr.LineStrips2D.columns(strips=outlines(cars.centres, cars.towards)).partition(cars.lengths))


def outlines(centres: Array, towards: Array) -> Array:
    """[N, 5, 2] the corners of cars with these centres and directions [N, 2], the first one again at the end."""
    forward = towards * CAR_LENGTH / 2
    right = np.stack([-towards[:, 1], towards[:, 0]], -1) * CAR_WIDTH / 2
    corners = [forward + right, forward - right, -forward - right, -forward + right, forward + right]
    return centres[:, None] + np.stack(corners, 1)
