"""A recording as the engine takes it: frames in the coordinates of its road, and the places where the ego may start."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cavbench.envs.recorded.corridor import BEYOND_M, Corridor, corridor
from cavbench.envs.recorded.scene import Floats, Recording, Track
from cavbench.envs.roads.network import Line, Network, record, straight
from cavbench.envs.roads.recordings import START, TRACK, Recordings

CARS = ("car", "taxi", "priorityVehicle", "unknown")
"""Road users whose place the ego may take."""
LONGEST_M = 7.0
"""It takes no longer ones."""
LEAST_M, LEAST_S = 20.0, 4.0
"""The recorded driver goes so far at least, and stays on the lanes for so long."""
ALIGNED = 0.3
"""A start heads along the lanes up to so many rad."""
EGO = (5.0, 2.0)
ROOM = (0.5, 0.1)
"""Length and width of the ego, and what must be free around it at a start, in m."""
ASIDE_M = 60.0
"""Road users that never come so near to the lanes are left out."""
MARGIN_M = 0.3
"""Cars up to so far beside a lane are on it: real lanes are narrow, and real cars are not in their middle."""
STARTS_A_SECOND, MOST_STARTS = 5, 5_000
FREE_PERCENTILE = 95
"""Of the recorded speeds: at which speed the rule-based driver wants to go."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Stage:
    """A scene to drive on.

    Args:
        road: a record `ROAD` of straight parallel lanes.
        recordings: what was recorded.
        corridor: the road.
    """

    road: NDArray[np.void]
    recordings: Recordings
    corridor: Corridor


def stage(recording: Recording, hz: int, seconds: float, change: float) -> Stage:
    """The road, the traffic and the starts of a scene.

    Args:
        recording: the scene.
        hz: physics frames per second.
        seconds: duration of an episode.
        change: by so many m/s the speed of the recorded driver changes at least within it.

    Raises:
        ValueError: in one line, if it has no road, or no car whose place the ego may take for so long.
    """
    found = corridor(recording)
    tracks, places = [], []
    for track in recording.tracks:
        moved = np.column_stack([found.coordinates(track.states[:, :3]), track.states[:, 3]])
        near = (np.abs(moved[:, 1]) < ASIDE_M) & (moved[:, 0] > -BEYOND_M) & (moved[:, 0] < found.length + BEYOND_M)
        if near.any():
            tracks.append(track)
            places.append(moved)
    frames = [_resampled(track, at, recording.step_s, hz) for track, at in zip(tracks, places, strict=True)]
    table = np.zeros(len(tracks), TRACK)
    offset = 0
    for row, track, (first, states) in zip(table, tracks, frames, strict=True):
        fastest = float(np.abs(states[:, 3]).max())
        for name, value in zip(
            TRACK.names or (), (offset, len(states), first, track.length, track.width, fastest), strict=False
        ):
            row[name] = value
        row["stands"] = not track.moves
        offset += len(states)
    starts = _starts(tracks, frames, found, recording.last * recording.step_s, hz, seconds, change)
    speeds = np.concatenate([states[_on(found, states), 3] for _, states in frames])
    return Stage(
        road=_road(found, float(np.percentile(speeds, FREE_PERCENTILE))),
        recordings=Recordings(np.concatenate([states for _, states in frames]), table, starts),
        corridor=found,
    )


def _road(found: Corridor, limit: float) -> NDArray[np.void]:
    """The lanes as a network; they go on straight at both ends."""
    network = Network()
    for lane in range(found.lanes):
        y = lane * found.lane_width
        sides = (
            Line.CONTINUOUS_LINE if lane == 0 else Line.STRIPED,
            Line.CONTINUOUS_LINE if lane == found.lanes - 1 else Line.NONE,
        )
        ends = [-BEYOND_M, y], [found.length + BEYOND_M, y]
        network.add("a", "b", straight(*ends, lines=sides, width=found.lane_width, margin=MARGIN_M, speed_limit=limit))
    return record(network, end=found.length)


def _resampled(track: Track, places: Floats, step_s: float, hz: int) -> tuple[int, Floats]:
    """The first physics frame of a track, and x, y, heading and speed [T, 4] in each frame from there on."""
    if not track.moves:
        return 0, places[:1]
    times = (track.first + np.arange(len(places))) * step_s
    first = math.ceil(times[0] * hz - 1e-6)
    at = np.arange(first, math.floor(times[-1] * hz + 1e-6) + 1) / hz
    if not len(at):
        return first, places[:1]
    columns = [*places[:, :2].T, np.unwrap(places[:, 2]), places[:, 3]]
    return first, np.stack([np.interp(at, times, column) for column in columns], 1)


def _on(found: Corridor, states: Floats) -> NDArray[np.bool_]:
    """Whether states [T, 4] are on the lanes and head along them."""
    x, y, heading = states[:, 0], states[:, 1], states[:, 2]
    half = found.lane_width / 2
    inside = (y > -half) & (y < (found.lanes - 1) * found.lane_width + half) & (x > 0) & (x < found.length)
    along: NDArray[np.bool_] = np.abs((heading + math.pi) % (2 * math.pi) - math.pi) < ALIGNED
    return inside & along


def _starts(
    tracks: list[Track],
    frames: list[tuple[int, Floats]],
    found: Corridor,
    lasts: float,
    hz: int,
    seconds: float,
    change: float,
) -> NDArray[np.void]:
    """Every start, so that those one after the other are of different cars."""
    if lasts < 0:
        raise ValueError("it has no road user that moves")
    wanted, least = round(seconds * hz), round(min(LEAST_S, seconds) * hz)
    latest = math.floor(lasts * hz + 1e-6) - wanted
    if latest < 0:
        raise ValueError(
            f"it was recorded for {lasts:.1f} s, an episode lasts {seconds:g} s: give a smaller world.max_steps"
        )
    made = []
    every = max(1, hz // STARTS_A_SECOND)
    for number, (track, (first, states)) in enumerate(zip(tracks, frames, strict=True)):
        if not track.moves or track.kind not in CARS or track.length > LONGEST_M:
            continue
        # The last frame up to which it stays on the lanes, from each one on.
        off = np.append(np.flatnonzero(~_on(found, states)), len(states))
        at = np.arange(-first % every, len(states), every)
        last = np.minimum(off[np.searchsorted(off, at)] - 1, at + wanted)
        way = states[np.maximum(last, at), 0] - states[at, 0]
        fits = (first + at <= latest) & (last - at >= least) & (way >= LEAST_M)
        fits &= _changes(states[:, 3], at, last) >= change
        pace = way / (np.maximum(last - at, 1) / hz)
        made.append(np.array(list(zip([number] * fits.sum(), first + at[fits], pace[fits], strict=True)), START))
    starts = np.concatenate([np.zeros(0, START), *made])
    starts = starts[np.random.default_rng(0).permutation(len(starts))[:MOST_STARTS]]
    starts = starts[_are_free(starts, tracks, frames)]
    if not len(starts):
        raise ValueError(
            f"it has no car on its lanes whose place the ego can take: one that drives on for {least / hz:g} s and "
            f"{LEAST_M:g} m and changes its speed by {change:g} m/s (world.change), {seconds:g} s before the recording ends"
        )
    return _dealt(starts)


def _changes(speeds: Floats, first: NDArray[np.int64], last: NDArray[np.int64]) -> Floats:
    """The largest difference of speeds from that in a first frame, up to a last one; 0 for frames that do not follow."""
    pairs = zip(first, last, strict=True)
    return np.array([np.abs(speeds[begin : end + 1] - speeds[begin]).max(initial=0) for begin, end in pairs])


def _are_free(starts: NDArray[np.void], tracks: list[Track], frames: list[tuple[int, Floats]]) -> NDArray[np.bool_]:
    """Whether nobody else is where the ego's body would be, at each start."""
    free = np.ones(len(starts), np.bool_)
    own = np.array([frames[s["track"]][1][s["frame"] - frames[s["track"]][0], :2] for s in starts]).reshape(-1, 2)
    for number, (track, (first, states)) in enumerate(zip(tracks, frames, strict=True)):
        at = starts["frame"] - first if track.moves else np.zeros(len(starts), np.int64)
        there = (at >= 0) & (at < len(states)) & (starts["track"] != number)
        along, across = np.abs(states[np.clip(at, 0, len(states) - 1), :2] - own).T
        close = (along < (EGO[0] + track.length) / 2 + ROOM[0]) & (across < (EGO[1] + track.width) / 2 + ROOM[1])
        free &= ~(there & close)
    return free


def _dealt(starts: NDArray[np.void]) -> NDArray[np.void]:
    """Starts in another order: first one of each car, then a second one of each."""
    seen: dict[int, int] = {}
    rounds = []
    for track in starts["track"].tolist():
        rounds.append(seen.get(track, 0))
        seen[track] = rounds[-1] + 1
    return starts[np.argsort(rounds, kind="stable")]
