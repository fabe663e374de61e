"""highway-env's own highway tasks as they are: rate, rows, ranges, traffic, rewards and ends of its default environments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from cavbench.driving import Control, DrivingFacts, Features
from cavbench.envs.highway.axes import AXES, FAST_V0, HIGHWAY_V0
from cavbench.envs.highway.config import FLOORS, THESIS_TARGET_SPEEDS, UNITS, HighwayConfig
from cavbench.envs.highway.keys import AXES as AXES_THERE
from cavbench.envs.highway.keys import decisions, fields_of, parsed
from cavbench.envs.highway.road import Backend, StraightRoad
from cavbench.identity.fingerprint import canonical
from cavbench.scenarios import Cell

NAMES = ("x", "y", "vx", "vy")
TOP_SPEED, LANE = 40.0, 4.0
TYPES = {"observation": "Kinematics", "action": "DiscreteMetaAction"}
DENSE = 1.5
"""Above this density most cars that only brake crash, because they cannot be told to drive below 20 m/s."""


def default_features(lanes: int) -> Features:
    """The ranges of KinematicObservation.normalize_obs: they follow from the largest speed and the width of the road."""
    high = (5 * TOP_SPEED, LANE * lanes, 2 * TOP_SPEED, 2 * TOP_SPEED)
    return Features(names=NAMES, low=tuple(-end for end in high), high=high, units=UNITS, floors=FLOORS)


class HighwayTask(StraightRoad):
    """A highway task of highway-env 1.12.1 as `gymnasium.make` makes it, on the compiled engine.

    Its observation, reward, terminated and truncated are those of highway-env after `reset(seed=s)`, for the scenario seed s.

    Args:
        config: changes of its configuration in highway-env's own keys, as in `config={duration: 60, vehicles_count: 30}`. Lanes
            and density are axes. A key that the engine does not know is refused.
    """

    brakes_by: ClassVar[str] = (
        "'world.config={action: {target_speeds: [10, 15, 20, 25, 30]}}' lets it, and is another task"
    )
    defaults: ClassVar[Mapping[str, Any]]
    """Fields of `HighwayConfig` that differ from those of all tasks; `duration` in seconds."""
    config: Mapping[str, Any] | str
    _fields: Mapping[str, Any]

    def __post_init__(self) -> None:
        given = parsed(self.config)
        own = {"lanes_count": self.home.lanes, "vehicles_density": self.home.density}
        changes = fields_of(given, own)
        # JSON: a dictionary would make the world unhashable.
        object.__setattr__(self, "config", canonical(given) if given else "")
        object.__setattr__(self, "_fields", _fields({**self.defaults, **changes}, self.home.lanes))
        super().__post_init__()
        object.__setattr__(self, "features", self.configuration((self.home,)).features_on(self.home.lanes))
        object.__setattr__(self, "max_steps", self.configuration((self.home,)).max_steps)

    def environment(self, cell: Cell) -> Any:
        """highway-env's own environment of this task on the road of a cell; it has no weather."""
        import gymnasium
        import highway_env

        gymnasium.register_envs(highway_env)
        given = parsed(self.config)
        # highway-env replaces all of `observation` and of `action`, and then needs their type.
        typed = {key: {"type": kind, **given[key]} for key, kind in TYPES.items() if key in given}
        axes = {key: cell[axis] for key, axis in AXES_THERE.items() if cell[axis] != self.home[axis]}
        return gymnasium.make(self.name, config=given | typed | axes)

    @property
    def observed_rows(self) -> int:
        return self.configuration((self.home,)).observed_vehicles

    @property
    def facts(self) -> DrivingFacts:
        return replace(super().facts, unbounded=True)

    def facts_at(self, cell: Cell) -> DrivingFacts:
        """The facts in a cell: y ends at the width of its road."""
        return replace(self.facts, features=self.configuration((self.home,)).features_on(cell.lanes))

    def doubts(self, cells: Sequence[Cell]) -> Sequence[str]:
        """Whether braking is enough: the task does not let a car drive below its lowest target speed."""
        slowest = self.configuration((self.home,)).target_speeds[0]
        densest = max(cell.density for cell in cells)
        if densest <= DENSE or slowest < THESIS_TARGET_SPEEDS[0]:
            return super().doubts(cells)
        return [
            f"density {densest:g} makes crashes without any attack: SLOWER ends at {slowest:g} m/s in this task. On three lanes "
            f"of highway-fast-v0 a car that only brakes crashes in 57 % of the episodes at {DENSE:g}, in 80 % at 2"
        ]

    def configuration(self, cells: Sequence[Cell], control: Control | None = None) -> HighwayConfig:
        control = control or Control()
        return HighwayConfig(
            cells=tuple(cells),
            action_type=control.action_type,
            driver=control.driver,
            action_repeat=control.action_repeat,
            traffic=control.traffic,
            surroundings=control.surroundings,
            **self._fields,
        )


def _fields(given: dict[str, Any], lanes: int) -> dict[str, Any]:
    """The fields of `HighwayConfig`: `duration` as a number of decisions, `ranges` as features."""
    found = {
        "policy_frequency": 1,
        "observed_vehicles": 5,
        "target_speeds": THESIS_TARGET_SPEEDS,
        "features": default_features(lanes),
        "lane_range": True,
        "offroad_terminal": False,
        **given,
    }
    found["max_steps"] = decisions(found.pop("duration"), found["policy_frequency"])
    if ranges := found.pop("ranges", None):
        low, high = zip(*(ranges[name] for name in NAMES), strict=True)
        found |= {"features": replace(found["features"], low=low, high=high), "lane_range": False}
    return found


@dataclass(frozen=True, kw_only=True)
class HighwayV0(HighwayTask):
    """highway-env's task `highway-v0`: 1 decision a second for 40 s, 50 cars, 4 lanes (highway-env 1.12.1).

    Args:
        config: changes in highway-env's own keys, as in `config={duration: 60, vehicles_count: 30}`. Lanes and density are axes.

    Raises:
        ValueError: if a key or a value is not known; the message is one line.
    """

    name: ClassVar[str] = HIGHWAY_V0.world
    grid: ClassVar[str] = HIGHWAY_V0.name
    home: ClassVar[Cell] = AXES.cell(lanes=4, density=1.0)
    features: ClassVar[Features] = default_features(4)
    defaults: ClassVar[Mapping[str, Any]] = {"vehicles": 50, "duration": 40.0}

    config: Mapping[str, Any] | str = ""
    backend: Backend = "batched"


@dataclass(frozen=True, kw_only=True)
class HighwayFastV0(HighwayTask):
    """highway-env's task `highway-fast-v0`: 1 decision a second for 30 s, 20 cars, 3 lanes, 5 frames a second.

    Only the ego collides, and the car ahead of it is nearer at the start (highway-env 1.12.1).

    Args:
        config: changes in highway-env's own keys, as in `config={duration: 60, vehicles_count: 30}`. Lanes and density are axes.

    Raises:
        ValueError: if a key or a value is not known; the message is one line.
    """

    name: ClassVar[str] = FAST_V0.world
    grid: ClassVar[str] = FAST_V0.name
    home: ClassVar[Cell] = AXES.cell(lanes=3, density=1.0)
    features: ClassVar[Features] = default_features(3)
    defaults: ClassVar[Mapping[str, Any]] = {
        "vehicles": 20,
        "duration": 30.0,
        "simulation_frequency": 5,
        "ego_spacing": 1.5,
        "others_collide": False,
    }

    config: Mapping[str, Any] | str = ""
    backend: Backend = "batched"
