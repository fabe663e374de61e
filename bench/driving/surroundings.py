"""How the other cars drive, and what the road and the load do to the ego: what a victim is not told."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Interval

from cavbench.core import ranges


@dataclass(frozen=True, kw_only=True)
class Surroundings:
    """Parameters of the traffic's IDM (Treiber et al. 2000) and MOBIL (Kesting et al. 2007), and of the ego's body.

    The defaults are highway-env's. No victim is told them: its kinematics (`DrivingFacts.kinematics`) stay those of the defaults.

    Args:
        acceleration: largest acceleration of the traffic, 0.5 to 6 m/s2 (IDM a).
        braking: comfortable braking of the traffic, 1 to 8 m/s2 (IDM b).
        jam_distance: distance between the centres of two cars that stand, 6 to 30 m (IDM s0 and a car).
        time_gap: desired time gap, 0.3 to 4 s (IDM T).
        lane_gain: gain of acceleration from which a car changes lane, -2 to 10 m/s2 (MOBIL's threshold).
        imposed_braking: braking that a lane change may impose on the car behind, 0 to 8 m/s2 (MOBIL b_safe).
        politeness: weight of what a lane change gains and costs the cars behind, 0 to 1 (MOBIL p).
        reaction: time for which a car of the traffic holds its decision, 0 to 2 s; 0 decides in every frame.
        mass: mass of the ego over the nominal one, 0.5 to 3: the same force accelerates and brakes less.
        friction: friction of the road, 0.1 to 1: below 1, the ego neither brakes, accelerates nor turns with more than this times
            9.81 m/s2. At 1 the road is dry and, as in highway-env, sets no limit.

    Raises:
        ValueError: if a value is out of its range.
    """

    acceleration: Annotated[float, Interval(ge=0.5, le=6)] = 3.0
    braking: Annotated[float, Interval(ge=1, le=8)] = 5.0
    jam_distance: Annotated[float, Interval(ge=6, le=30)] = 10.0
    time_gap: Annotated[float, Interval(ge=0.3, le=4)] = 1.5
    lane_gain: Annotated[float, Interval(ge=-2, le=10)] = 0.2
    imposed_braking: Annotated[float, Interval(ge=0, le=8)] = 2.0
    politeness: Annotated[float, Interval(ge=0, le=1)] = 0.0
    reaction: Annotated[float, Interval(ge=0, le=2)] = 0.0
    mass: Annotated[float, Interval(ge=0.5, le=3)] = 1.0
    friction: Annotated[float, Interval(ge=0.1, le=1)] = 1.0

    def __post_init__(self) -> None:
        ranges.check(self)


USUAL = Surroundings()
"""highway-env's own traffic, and a nominal car on a dry road."""
