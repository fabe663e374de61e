"""The road from above in metres, moving with the ego: measured cars, and cars in the attacked observation."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from cavbench.driving.recording.episode import Array, Episode
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


def log(episode: Episode, columns: Columns) -> None:
    """Send the road and the cars, if the observation has positions."""
    if not {"x", "y"} <= set(episode.features.names):
        return
    _road(episode, columns)
    _cars(episode, columns)


def bounds(episode: Episode) -> tuple[tuple[float, float], tuple[float, float]]:
    """Initial x and y range of the view, in m."""
    low, high = edges(episode)
    return (-45.0, 105.0), (low - 2.5, high + 2.5)


def edges(episode: Episode) -> tuple[float, float]:
    """y of the left and right edge of the road, in m."""
    lanes = json.loads(str(episode.meta.get("cell", "{}"))).get("lanes")
    if lanes is None:
        ego = episode.physical("observation", "y")[:, 0]
        lanes = max(1, round(float(ego.max()) / LANE_WIDTH) + 1)
    return -LANE_WIDTH / 2, (int(str(lanes)) - 0.5) * LANE_WIDTH


def _road(episode: Episode, columns: Columns) -> None:
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
    """Centres of vehicles, of all steps in sequence, and their number in each step."""

    centres: Array
    lengths: NDArray[np.int64]


def _others(episode: Episode, name: str) -> _Cars:
    """Positions of the other vehicles in `observation` or `perturbed`, relative to the ego's true position."""
    ego = episode.physical("observation", "y")[:, :1]
    x, y = (episode.physical(name, feature)[:, 1:] for feature in ("x", "y"))
    centres = np.stack([x, y + ego], -1)
    return _Cars(centres[episode.present], episode.present.sum(1))


def _cars(episode: Episode, columns: Columns) -> None:
    traffic = _others(episode, "observation")
    _bodies(columns, "traffic/measured", traffic, MEASURED)
    ego = episode.physical("observation", "y")[:, 0]
    place = np.stack([np.zeros(len(episode)), ego], -1)
    one = np.ones(len(episode), np.int64)
    crashed = np.asarray(episode.steps["crashed"], dtype=bool)
    _bodies(columns, "ego/measured", _Cars(place, one), EGO, np.where(crashed[:, None], CRASHED, EGO))
    if episode.attacked:
        shown = _others(episode, "perturbed")
        _ghosts(columns, "traffic/shown", shown)
        ghost = np.stack([np.zeros(len(episode)), episode.physical("perturbed", "y")[:, 0]], -1)
        _ghosts(columns, "ego/shown", _Cars(ghost, one))
        columns.fixed("traffic/moved", rr.Arrows2D.from_fields(radii=[0.12], colors=[SHOWN], draw_order=4.0))
        vectors = rr.Arrows2D.columns(vectors=shown.centres - traffic.centres, origins=traffic.centres)
        columns.send("traffic/moved", vectors.partition(traffic.lengths))


def _bodies(
    columns: Columns, path: str, cars: _Cars, colour: Colour, colours: NDArray[np.generic] | None = None
) -> None:
    """Send filled cars as thick lines (rerun draws only outlines of boxes); `colours`: one for each car, if they differ."""
    half = np.array([(CAR_LENGTH - CAR_WIDTH) / 2, 0.0])
    strips = np.stack([cars.centres - half, cars.centres + half], 1)
    per_car = np.broadcast_to(colour, (len(strips), 3)) if colours is None else colours
    columns.fixed(path, rr.LineStrips2D.from_fields(radii=[CAR_WIDTH / 2], draw_order=2.0))
    columns.send(path, rr.LineStrips2D.columns(strips=strips, colors=per_car.astype(np.uint8)).partition(cars.lengths))


def _ghosts(columns: Columns, path: str, cars: _Cars) -> None:
    """Send outlines of the cars in the attacked observation."""
    half = np.broadcast_to([CAR_LENGTH / 2, CAR_WIDTH / 2], cars.centres.shape)
    columns.fixed(path, rr.Boxes2D.from_fields(radii=[0.15], colors=[SHOWN], draw_order=3.0))
    columns.send(path, rr.Boxes2D.columns(centers=cars.centres, half_sizes=half).partition(cars.lengths))
