"""The state of the engine: one record for a body on the road, one for an episode, and the parameters of all episodes.

The cars of an episode are in highway-env's order, because several of its rules depend on the order; obstacles come after them.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Protocol, overload

import numpy as np
from numpy.typing import NDArray

from cavbench.envs.highway.state import record_type
from cavbench.envs.roads.network import EdgeRecord, LaneRecord

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


class Kind(IntEnum):
    """What a body on the road is: highway-env's MDPVehicle, Vehicle, IDMVehicle or Obstacle, or a car that is replayed."""

    DISCRETE = 0
    CONTINUOUS = 1
    IDM = 2
    OBSTACLE = 3
    RECORDED = 4


class Feature(IntEnum):
    """Features of a row; the first four are noisy and relative to the ego."""

    X = 0
    Y = 1
    VX = 2
    VY = 3
    PRESENCE = 4
    COS_H = 5
    SIN_H = 6
    LONG_OFF = 7
    LAT_OFF = 8
    ANG_OFF = 9


class ViewKind(IntEnum):
    """What an observation is: rows of cars, rows with the place of the exit, a grid of cells, or of times to collision."""

    ROWS = 0
    EXIT_ROWS = 1
    OCCUPANCY = 2
    TIMES = 3


class Measure(IntEnum):
    """What a world calls progress: that of the highway, metres of the way to a goal, speed along the lane, or metres along the
    road as far as a recorded driver came."""

    HIGHWAY = 0
    WAY = 1
    LANE = 2
    PACE = 3


class Body:
    """One car or obstacle."""

    x: float  # m
    y: float  # m
    along: float  # m on its lane
    across: float  # m to the right of its lane's centre
    lane: int  # the closest one
    other_lane: int  # one of which the next two are stored until the body moves, or -1
    other_along: float  # m on that lane
    other_across: float  # m to the right of its centre
    speed: float  # m/s, signed
    cos_heading: float
    sin_heading: float
    heading: float  # rad
    kind: int
    target_lane: int
    target_speed: float  # m/s
    steering: float  # rad
    acceleration: float  # m/s2
    timer: float  # s since a lane change was last considered
    delta: float  # exponent of the IDM
    route: int  # row of the table of routes, -1 without one
    route_place: int  # the next road of the route
    speed_index: int  # of the target speed in the table, of a discrete ego
    length: float  # m
    width: float  # m
    impact_x: float  # m, the push of a collision, applied in the next frame
    impact_y: float  # m
    impact: bool  # whether one is pending
    crashed: bool
    changes_lanes: bool  # whether MOBIL is on
    yielding: bool  # whether it waits at a crossing
    slides: bool  # whether its tyres slip
    lateral_speed: float  # m/s to the right, of a car that slides
    yaw_rate: float  # rad/s, of a car that slides


class Episode:
    """One episode."""

    network: int
    cars: int  # number of cars
    bodies: int  # number of cars and obstacles
    ego: int  # number of the ego
    traffic: int  # number of cars that the cell asks for
    oncoming: int  # number of those on the opposite lane
    density: float  # by which the distances between cars are divided at the start
    opposing: float  # the same on the opposite lane
    arrivals: float  # chance that a car comes after a decision
    goal: int  # number of the ego's destination
    first_track: int  # number of its scene's first track among those of the batch
    track_count: int  # how many its scene has
    first_start: int  # number of its scene's first start
    start_count: int  # how many its scene has
    reaction: int  # of recorded cars, `Reaction`
    begin: int  # frame of the recording at which the episode began
    taken: int  # number of the track whose place the ego has taken
    pace: float  # m/s, the mean speed of the recorded driver
    seed: int  # scenario seed
    steps: int  # decisions so far
    frames: int  # physics frames so far, on a regulated road
    time: float  # s, as highway-env adds it up
    driven: float  # m since the start
    ahead: float  # m of the way to the goal that have not counted as progress yet
    sensor_range: float  # m
    noise_sigma: float  # m and m/s
    range_y: float  # m, the default range of y in observations, fixed at the reset
    reward: float  # of the last action
    progress: float  # of the last action, in [0, 1] per decision
    ttc: float  # s, time to collision
    crashed: bool
    offroad: bool
    arrived: bool
    terminated: bool
    truncated: bool


class Place:
    """A body on a lane or within its margin; the first of a row has no place, but the number of those after it."""

    body: int  # its number
    along: float  # m on the lane


BODY = record_type(Body)
EPISODE = record_type(Episode)
PLACE = record_type(Place)


class Bodies(Protocol):
    """The bodies [N] of an episode in compiled code: a numpy array of `BODY`."""

    size: int

    @overload
    def __getitem__(self, number: int) -> Body: ...
    @overload
    def __getitem__(self, number: slice) -> Bodies: ...
    def copy(self) -> Bodies: ...
    def __setitem__(self, number: slice, bodies: Bodies) -> None: ...


class OnLane(Protocol):
    """The bodies on one lane in compiled code: an array [1 + N] of `PLACE`."""

    def __getitem__(self, number: int) -> Place: ...


class Places(Protocol):
    """The bodies on each lane in compiled code: an array [L, 1 + N] of `PLACE`."""

    def __getitem__(self, lane: int) -> OnLane: ...


class Lanes(Protocol):
    """Lanes in compiled code: an array of `LANE`."""

    def __getitem__(self, number: int) -> LaneRecord: ...


class Edges(Protocol):
    """Roads in compiled code: an array of `EDGE`."""

    def __getitem__(self, number: int) -> EdgeRecord: ...


class Road(Protocol):
    """The network of an episode in compiled code: a record `ROAD`."""

    lane_count: int
    edge_count: int
    end: float
    factor: float
    spots: Integers
    lanes: Lanes
    edges: Edges
    near: NDArray[np.int8]
    linked: Integers
    offsets: Floats
    routes: Integers
    route_lanes: Integers
    reach: NDArray[np.int8]
    way_after: Floats
    way_length: Floats
    astray: NDArray[np.int8]


class Parameters(Protocol):
    """The parameters of all episodes of a batch in compiled code: a record `PARAMETERS`; documented in `RoadsConfig`."""

    task: int
    ego: int
    substeps: int
    simulation_frequency: int
    regulation: int  # frames between two decisions about the right of way, 0 for never
    dt: float
    period: float
    duration: float
    max_steps: int
    full_steps: int  # `max_steps` of the world, also in a planner's copies
    action_repeat: int
    actions: Integers  # the five discrete actions, by the task's numbers
    choices: int  # how many numbers the task has
    layout: int  # `ViewKind`
    horizon: int  # steps of a grid of times to collision
    speeds: int  # number of target speeds
    target_speeds: Floats
    default_speeds: Floats  # highway-env's
    idm_acceleration: float
    idm_braking: float
    gap_scale: float  # 2 sqrt(a b)
    jam_distance: float
    reward_speed_low: float
    reward_speed_high: float
    progress: int  # `Measure`
    lane_weight: float
    reference_speed: float  # m/s
    offroad_terminal: bool
    slides: bool
    odometer: bool
    shoulder: float  # m
    columns: int  # of an observation
    features: Integers  # numbers of `Feature`
    low: Floats  # of x, y, vx, vy
    high: Floats
    default_range: bool
    clipped: bool
    relative: bool
    obstacles: bool


MOST_SPEEDS, MOST_COLUMNS = 32, 16
_SHAPES = {
    "target_speeds": (MOST_SPEEDS,),
    "default_speeds": (3,),
    "features": (MOST_COLUMNS,),
    "actions": (5,),
    "low": (4,),
    "high": (4,),
}
_KINDS = {"float": np.float64, "int": np.int64, "bool": np.bool_, "Floats": np.float64, "Integers": np.int64}
PARAMETERS = np.dtype(
    [(name, _KINDS[kind], _SHAPES.get(name, ())) for name, kind in Parameters.__annotations__.items()], align=True
)
