"""Roads that are not straight: where their lanes are, and where cars are and look on them, in metres from above."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cavbench.driving.recording.episode import Array, Episode

FLAT = 40.0
"""A road that is not wider than this in m runs along x, and is drawn around the ego's x."""
SLOW = 1.0
"""Below this speed in m/s a car looks along the nearest lane, above it where it drives to."""


@dataclass(frozen=True)
class Plan:
    """The lanes of an episode, and the directions of its cars.

    Args:
        episode: an episode whose facts have lanes.
    """

    episode: Episode

    @cached_property
    def lines(self) -> list[Array]:
        """The centre lines [N, 2] of the lanes."""
        return [np.array(lane.line) for lane in self.episode.facts.lanes]

    @property
    def widths(self) -> Array:
        """The widths of the lanes."""
        return np.array([lane.width for lane in self.episode.facts.lanes])

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """The lowest and the highest x, y of all lanes, with their widths."""
        points, margin = np.concatenate(self.lines), float(self.widths.max()) / 2
        return points.min(0) - margin, points.max(0) + margin

    @property
    def bends(self) -> bool:
        """Whether no direction is the forward one; then the picture stands, and the ego moves in it."""
        low, high = self.bounds
        return bool(high[1] - low[1] > FLAT)

    @cached_property
    def ego(self) -> Array:
        """[T, 2] where the ego is."""
        x = self.episode.physical("observation", "x")[:, 0] if self.bends else self.episode.steps["x"]
        return np.stack([np.asarray(x, dtype=np.float64), self.episode.physical("observation", "y")[:, 0]], -1)

    def near(self, x: float, behind: float, ahead: float) -> list[tuple[float, Array]]:
        """Width and line of the lanes between `behind` and `ahead` m of a place; straight lines are cut there."""
        found = []
        for width, line in zip(self.widths, self.lines, strict=True):
            low, high = x - behind, x + ahead
            if line[:, 0].max() < low or line[:, 0].min() > high:
                continue
            if len(line) == 2 and line[0, 1] == line[1, 1]:
                line = np.stack([line[:, 0].clip(low, high), line[:, 1]], -1)
            found.append((float(width), line - [x, 0.0]))
        return found

    def directions(self, name: str = "observation") -> Array:
        """[T, V, 2] unit vectors in which the cars look: the ego first, as in the observation."""
        moves = np.stack([self.episode.physical(name, axis) for axis in ("vx", "vy")], -1)
        moves[:, 1:] += moves[:, :1]
        speeds = np.linalg.norm(moves, axis=-1, keepdims=True)
        return np.where(speeds < SLOW, self._along(), moves / speeds.clip(1e-9))

    def _along(self) -> Array:
        """[T, V, 2] the direction of the lane that is nearest to each car."""
        starts = np.concatenate([line[:-1] for line in self.lines])
        ends = np.concatenate([line[1:] for line in self.lines])
        towards = (ends - starts) / np.linalg.norm(ends - starts, axis=1, keepdims=True).clip(1e-9)
        places = np.stack([self.episode.physical("observation", axis) for axis in ("x", "y")], -1)
        places = np.concatenate([self.ego[:, None], places[:, 1:] + self.ego[:, None]], 1)
        nearest = np.zeros(places.shape[:2], np.int64)
        least = np.full(places.shape[:2], np.inf)
        for number, (start, end) in enumerate(zip(starts, ends, strict=True)):
            share = ((places - start) @ (end - start) / max(((end - start) ** 2).sum(), 1e-9)).clip(0, 1)
            far = np.linalg.norm(places - start - share[..., None] * (end - start), axis=-1)
            nearest, least = np.where(far < least, number, nearest), np.minimum(far, least)
        return np.asarray(towards[nearest], dtype=np.float64)
