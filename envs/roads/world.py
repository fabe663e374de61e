"""What the worlds of road networks have in common. A world is its roads, its rules and its numbers; everything else is here."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

from cavbench.driving import ActionType, Control, Driver, DrivingFacts, DrivingWorld, Dynamics, Features, Kinematics
from cavbench.driving.way import Way
from cavbench.envs.highway.config import ACTIONS, KINEMATICS, STANDARD_FEATURES, STANDARD_TARGET_SPEEDS
from cavbench.envs.roads.config import RoadsConfig, Scene
from cavbench.envs.roads.shape import drawn
from cavbench.envs.roads.state import ViewKind
from cavbench.envs.weather import WEATHERS
from cavbench.scenarios import Cell

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

PLANE = replace(STANDARD_FEATURES, low=(-160.0, -160.0, -30.0, -30.0), high=(160.0, 160.0, 30.0, 30.0))
"""Ranges for roads that bend: no direction is the forward one."""


@dataclass(frozen=True, kw_only=True)
class RoadsWorld(DrivingWorld):
    """A world on the engine of road networks, with the cars, features and decisions of `highway`.

    A world names its axes, its grid, a cell (`home`) and its `rules`, and implements `scene`.

    Args:
        connected: whether cars look for their neighbours on the lanes before and after their own, too: highway-env's v1 of the
            task (v2 of the intersection); without it, v0.
        observed_vehicles: number of rows in an observation, including the ego.
        target_speeds: speeds in m/s for FASTER and SLOWER.
        simulation_frequency, policy_frequency: physics frames and decisions per second.
        max_steps: number of decisions until an episode is truncated.
        offroad_terminal: whether leaving the road ends the episode.

    Raises:
        ValueError: if a value is not allowed; the message is one line.
    """

    features: ClassVar[Features] = STANDARD_FEATURES
    actions: ClassVar[tuple[str, ...]] = ACTIONS
    drivers: ClassVar[tuple[Driver, ...]] = ("agent", "idm", "clairvoyant")
    home: ClassVar[Cell]
    """A cell of this world, for checks that do not depend on it."""
    rules: ClassVar[Mapping[str, Any]]
    """The arguments of `RoadsConfig` that name the task, its traffic and its progress."""
    lane_changes: ClassVar[bool] = True
    """Whether the other cars change lanes."""
    start_speed: ClassVar[float | None] = None
    """The ego's speed at the start in m/s, if it drives on parallel lanes, so that a policy can predict its motion."""
    comes_towards: ClassVar[bool] = False
    """Whether others come towards the ego on one of these lanes."""
    lane_width: ClassVar[float] = KINEMATICS["lane_width"]
    """Of the lanes, in m."""

    connected: bool = True
    observed_vehicles: int = 10
    target_speeds: tuple[float, ...] = STANDARD_TARGET_SPEEDS
    simulation_frequency: int = 15
    policy_frequency: int = 15
    max_steps: int = 300
    offroad_terminal: bool = True

    def __post_init__(self) -> None:
        # A list from a configuration file would make the world unhashable.
        object.__setattr__(self, "target_speeds", tuple(float(speed) for speed in self.target_speeds))
        if not 1 <= self.policy_frequency <= self.simulation_frequency or (
            self.simulation_frequency % self.policy_frequency
        ):
            raise ValueError(
                f"policy_frequency must divide simulation_frequency ({self.simulation_frequency}), got {self.policy_frequency}"
            )
        self._configured((self.sketch(),), Control())

    def sketch(self) -> Scene:
        """The scene that parameters are checked with."""
        return self.scene(self.home)

    @abstractmethod
    def scene(self, cell: Cell) -> Scene:
        """The road and the traffic of a cell; equal roads must be the same object."""

    @property
    def decision_hz(self) -> float:
        return self.policy_frequency

    @property
    def kinematics(self) -> Kinematics | None:
        if self.start_speed is None:
            return None
        frames = self.simulation_frequency // self.policy_frequency
        constants = {
            **KINEMATICS,
            "lane_width": self.lane_width,
            "start_speed": self.start_speed,
            "oncoming": self.comes_towards,
            "way": self.way,
        }
        return Kinematics(frames=frames, target_speeds=self.target_speeds, **constants)

    @property
    def way(self) -> Way | None:
        """The way that all cars follow, if the lanes bend."""
        return None

    @property
    def observed_rows(self) -> int:
        return self.observed_vehicles

    @property
    def facts(self) -> DrivingFacts:
        return replace(super().facts, environment=self.gym_call)

    def facts_at(self, cell: Cell) -> DrivingFacts:
        """The facts in a cell: with the lanes of its road."""
        return replace(self.facts, lanes=drawn(self.scene(cell).road[0]))

    def config(self, cells: Sequence[Cell], control: Control | None = None) -> RoadsConfig:
        """The environment's full configuration; arguments as in `DrivingWorld.build`."""
        # Imported here because it loads numba, which `bench list` must not load.
        from cavbench.envs.highway.sensor import noise_sigma, sensor_range_m

        scenes = []
        for cell in cells:
            weather = WEATHERS[cell.weather]
            reach, sigma = sensor_range_m(weather), noise_sigma(weather)
            scenes.append(replace(self.scene(cell), sensor_range=reach, noise_sigma=sigma))
        return self._configured(tuple(scenes), control or Control())

    def _configured(self, scenes: tuple[Scene, ...], control: Control) -> RoadsConfig:
        return RoadsConfig(
            **self.rules,
            scenes=scenes,
            simulation_frequency=self.simulation_frequency,
            policy_frequency=self.policy_frequency,
            max_steps=self.max_steps,
            action_type=control.action_type,
            driver=control.driver,
            action_repeat=control.action_repeat,
            target_speeds=self.target_speeds,
            low=self.features.low,
            high=self.features.high,
            observed_vehicles=self.observed_vehicles,
            offroad_terminal=self.offroad_terminal,
        )

    def build(self, cells: Sequence[Cell], control: Control) -> EnvBase:
        """See `cavbench.driving.DrivingWorld.build`."""
        # Imported here because it loads torchrl and numba, which `bench list` must not load.
        from cavbench.envs.roads.environment import RoadsEnv

        return RoadsEnv(self.config(cells, control))

    def dynamics(self, cells: Sequence[Cell], action_type: ActionType) -> Dynamics | None:
        """See `cavbench.driving.DrivingWorld.dynamics`. None for a world that observes no rows of cars."""
        # Imported here because it loads torch and numba, which `bench list` must not load.
        from cavbench.envs.roads.foresight import RoadsDynamics

        config = self.config(cells, Control(action_type=action_type))
        return RoadsDynamics(config, changes_lanes=self.lane_changes) if config.view == ViewKind.ROWS else None
