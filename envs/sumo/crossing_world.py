"""The world `sumo_crossing`: an urban crossing in the traffic of SUMO."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

from cavbench.driving import DrivingFacts, Features
from cavbench.driving.features import LaneShape
from cavbench.envs.highway.config import FLOORS, KINEMATICS, UNITS
from cavbench.envs.highway.dynamics import LANE_WIDTH
from cavbench.envs.sumo.axes import CROSSING, SUMO_CROSSING_V1
from cavbench.envs.sumo.cars import PERIOD_MS
from cavbench.envs.sumo.crossing import LENGTH, MIDDLE
from cavbench.envs.sumo.crossing_cars import start
from cavbench.envs.sumo.roads import Road
from cavbench.envs.sumo.world import SumoTraffic
from cavbench.scenarios import Axes, Cell

if TYPE_CHECKING:
    from cavbench.envs.sumo.engine import Scene

FEATURES = Features(
    names=("x", "y", "vx", "vy"),
    low=(-300.0, -100.0, -30.0, -30.0),
    high=(300.0, 100.0, 30.0, 30.0),
    units=UNITS,
    floors=FLOORS,
)
"""Cars come from all sides, so their speeds along and across have the same range. x also
says how far the ego is from the crossing, which is at 120 m."""


@dataclass(frozen=True, kw_only=True)
class SumoCrossingWorld(SumoTraffic):
    """An urban crossing in traffic of SUMO 1.28 (Krauss and EIDM, sublane changes), 67 ms a decision, for 20.1 s.

    The ego goes straight on. The traffic ahead of it, towards it and across goes straight on or turns, by SUMO's rules of way.
    It needs pip install 'cavbench[sumo]'.
    """

    name: ClassVar[str] = SUMO_CROSSING_V1.world
    axes: ClassVar[Axes] = CROSSING
    grid: ClassVar[str] = SUMO_CROSSING_V1.name
    features: ClassVar[Features] = FEATURES
    home: ClassVar[Cell] = CROSSING.cell(lanes=2, density=1.0, rule="yield")
    longest: ClassVar[int] = int(LENGTH / (KINEMATICS["top_speed"] * PERIOD_MS / 1000))
    rewarded: ClassVar[tuple[float, float]] = (0.0, 15.0)

    vehicles: int = 24
    observed_vehicles: int = 21
    target_speeds: tuple[float, ...] = (0.0, 5.0, 10.0, 15.0)
    max_steps: int = 300

    def facts_at(self, cell: Cell) -> DrivingFacts:
        """The facts in a cell: with the lanes of its road."""
        ways = [(1, LANE_WIDTH * lane) for lane in range(cell.lanes)]
        ways += [(-1, -LANE_WIDTH * (lane + 1)) for lane in range(cell.lanes)]
        along = [((MIDDLE - way * LENGTH, y), (MIDDLE + way * LENGTH, y)) for way, y in ways]
        # The left edge of the ego's lanes goes through the middle of the crossing.
        middle = -LANE_WIDTH / 2
        sides = [(MIDDLE + way * LANE_WIDTH / 2, middle + way * LENGTH, middle - way * LENGTH) for way in (1, -1)]
        across = [((x, begin), (x, end)) for x, begin, end in sides]
        return replace(self.facts, lanes=tuple(LaneShape(width=LANE_WIDTH, line=line) for line in (*along, *across)))

    def scene(self) -> Scene:
        """A crossing."""
        from cavbench.envs.sumo.engine import Scene

        return Scene(layout="crossing", road=lambda cell: Road(cell.lanes, cell.rule), start=start, speed_alone=True)
