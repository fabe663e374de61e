"""A recorded scene: lanelets, the tracks of road users, and where an ego shall start."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Lanelet:
    """A piece of a lane, in driving direction.

    Args:
        number: its id.
        left, right: [N, 2] points x, y of its borders in m, as many on both.
        before, after: ids of the pieces that lead to it, and to which it leads.
        beside: ids of the pieces at its left and at its right side that lead in the same direction; None for none.
    """

    number: int
    left: Floats
    right: Floats
    before: tuple[int, ...] = ()
    after: tuple[int, ...] = ()
    beside: tuple[int | None, int | None] = (None, None)

    @property
    def centre(self) -> Floats:
        """[N, 2] points halfway between the borders."""
        return (self.left + self.right) / 2


@dataclass(frozen=True, kw_only=True, eq=False)
class Track:
    """The recorded motion of a road user.

    Args:
        number: its id.
        kind: what it is, by CommonRoad's names: car, truck, pedestrian.
        length, width: of the rectangle around it, in m.
        first: number of the time step of its first state; one state follows each time step.
        states: [T, 4] x and y of the middle of the rectangle in m, heading in rad, and speed in m/s.
        moves: whether it was recorded; otherwise it stands there all the time, and T is 1.
    """

    number: int
    kind: str
    length: float
    width: float
    first: int
    states: Floats
    moves: bool = True


@dataclass(frozen=True, kw_only=True)
class Problem:
    """Where an ego shall start: x, y in m, heading in rad, speed in m/s."""

    number: int
    x: float
    y: float
    heading: float
    speed: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """A recorded scene.

    Args:
        name: its name in errors.
        version: version of the format.
        step_s: seconds from one time step to the next.
        lanelets: by id.
        tracks: every road user.
        problems: the planning problems.
    """

    name: str
    version: str
    step_s: float
    lanelets: dict[int, Lanelet]
    tracks: tuple[Track, ...]
    problems: tuple[Problem, ...]

    @property
    def last(self) -> int:
        """Number of the last time step of any road user that moves; -1 if none does."""
        return max((track.first + len(track.states) - 1 for track in self.tracks if track.moves), default=-1)
