"""Recorded traffic as arrays for compiled code: the frames of every track, and the places where the ego may start."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from cavbench.envs.highway.state import record_type
from cavbench.envs.roads.state import Floats


class Reaction(IntEnum):
    """What recorded cars do: they are replayed, follow IDM as soon as the ego matters, or follow IDM from the start."""

    REPLAY = 0
    MIXED = 1
    REACTIVE = 2


class TrackRecord:
    """The recorded motion of one road user in compiled code."""

    offset: int  # row of its first frame
    count: int  # number of its frames
    first: int  # physics frame of the scene at which the first one is due
    length: float  # m
    width: float  # m
    fastest: float  # m/s, its highest recorded speed
    stands: bool  # whether it is there all the time, in its only frame


class StartRecord:
    """A place in the recording that the ego may take."""

    track: int  # number of the road user whose place it is, among those of the scene
    frame: int  # physics frame of the scene
    pace: float  # m/s, the mean speed of that road user afterwards


TRACK = record_type(TrackRecord)
START = record_type(StartRecord)


class Tracks(Protocol):
    """Tracks in compiled code: an array of `TRACK`."""

    size: int

    def __getitem__(self, number: int) -> TrackRecord: ...


class Starts(Protocol):
    """Starts in compiled code: an array of `START`."""

    size: int

    def __getitem__(self, number: int) -> StartRecord: ...


class Recordings(NamedTuple):
    """The recordings of all scenes of a batch.

    Args:
        frames: [N, 4] x, y in m, heading in rad and speed in m/s.
        tracks: [T] records `TRACK`.
        starts: [S] records `START`.
    """

    frames: Floats
    tracks: NDArray[np.void]
    starts: NDArray[np.void]


NOTHING = Recordings(np.zeros((0, 4)), np.zeros(0, TRACK), np.zeros(0, START))
"""What a world without recordings has."""


def joined(parts: list[Recordings]) -> tuple[Recordings, NDArray[np.int64]]:
    """Recordings in one, and [P, 4] where the tracks and starts of each part begin in it, and how many there are."""
    rows, bounds, tracks = 0, [], []
    first_track = first_start = 0
    for part in parts:
        moved = part.tracks.copy()
        moved["offset"] += rows
        tracks.append(moved)
        bounds.append((first_track, len(part.tracks), first_start, len(part.starts)))
        rows, first_track, first_start = (
            rows + len(part.frames),
            first_track + len(part.tracks),
            first_start + len(part.starts),
        )
    whole = Recordings(
        np.concatenate([part.frames for part in parts]),
        np.concatenate(tracks).view(TRACK),
        np.concatenate([part.starts for part in parts]).view(START),
    )
    return whole, np.array(bounds, dtype=np.int64)
