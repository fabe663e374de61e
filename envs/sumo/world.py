"""The worlds with the traffic of SUMO, and the first of them, `sumo`: a motorway with an on-ramp."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

from cavbench.driving import ActionType, Control, Driver, DrivingFacts, DrivingWorld, Dynamics, Features, Kinematics
from cavbench.driving.kinematics import CarFollowing
from cavbench.envs.highway.config import ACTIONS, KINEMATICS, STANDARD_FEATURES, STANDARD_TARGET_SPEEDS, HighwayConfig
from cavbench.envs.sumo.axes import SUMO, SUMO_V1
from cavbench.envs.sumo.cars import ACCELERATION, BRAKING, PERIOD_MS, STANDING_GAP, TIME_GAP, start
from cavbench.envs.sumo.motorway import LENGTH, START
from cavbench.envs.sumo.network import LIBRARIES, check_installed
from cavbench.envs.sumo.roads import Road
from cavbench.scenarios import Axes, Cell

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

    from cavbench.envs.sumo.engine import Scene

FOLLOWING = CarFollowing(
    acceleration=ACCELERATION,
    braking=BRAKING,
    jam_distance=STANDING_GAP + float(KINEMATICS["length"]),
    time_gap=TIME_GAP,
    free_share=0.5,
)
MOST_PROCESSES = 64


@dataclass(frozen=True, kw_only=True)
class SumoTraffic(DrivingWorld):
    """What the worlds have in common whose traffic SUMO drives. They need pip install 'cavbench[sumo]'.

    Args:
        vehicles: number of cars of the traffic.
        observed_vehicles: number of rows in an observation, including the ego.
        target_speeds: speeds in m/s for FASTER and SLOWER.
        max_steps: number of decisions until an episode is truncated.
        offroad_terminal: whether leaving the road ends the episode.
        processes: simulations that share a batch, each in a process of its own; no result depends on it.

    Raises:
        ValueError: if a value is not allowed; the message is one line.
    """

    actions: ClassVar[tuple[str, ...]] = ACTIONS
    drivers: ClassVar[tuple[Driver, ...]] = ("agent", "idm")
    libraries: ClassVar[tuple[str, ...]] = LIBRARIES
    home: ClassVar[Cell]
    """The cell that stands for the world where none is chosen."""
    longest: ClassVar[int]
    """Decisions in which no ego comes to the end of the road."""
    rewarded: ClassVar[tuple[float, float]]
    """Speeds in m/s at which the share of the speed is 0 and 1."""

    vehicles: int = 20
    observed_vehicles: int = 10
    target_speeds: tuple[float, ...] = STANDARD_TARGET_SPEEDS
    max_steps: int = 450
    offroad_terminal: bool = True
    processes: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        # A list from a configuration file would make the world unhashable.
        object.__setattr__(self, "target_speeds", tuple(float(speed) for speed in self.target_speeds))
        if not 1 <= self.processes <= MOST_PROCESSES:
            raise ValueError(f"processes must be between 1 and {MOST_PROCESSES}, got {self.processes}")
        if self.max_steps > self.longest:
            raise ValueError(f"max_steps must be at most {self.longest}, where the road ends, got {self.max_steps}")
        self.configuration((self.home,))

    @property
    def decision_hz(self) -> float:
        return 1000 / PERIOD_MS

    @property
    def observed_rows(self) -> int:
        return self.observed_vehicles

    @property
    def facts(self) -> DrivingFacts:
        return replace(super().facts, environment=self.gym_call)

    def configuration(self, cells: Sequence[Cell], control: Control | None = None) -> HighwayConfig:
        """The configuration of the code of `highway` that moves the ego; arguments as in `DrivingWorld.build`."""
        control = control or Control()
        return HighwayConfig(
            cells=tuple(cells),
            vehicles=self.vehicles,
            max_steps=self.max_steps,
            action_type=control.action_type,
            driver=control.driver,
            action_repeat=control.action_repeat,
            target_speeds=self.target_speeds,
            features=self.features,
            observed_vehicles=self.observed_vehicles,
            offroad_terminal=self.offroad_terminal,
            reward_speed_range=self.rewarded,
        )

    @abstractmethod
    def scene(self) -> Scene:
        """Where the traffic drives."""

    def doubts(self, cells: Sequence[Cell]) -> Sequence[str]:
        """None.

        Raises:
            UserError: if SUMO is not installed.
        """
        check_installed()
        return ()

    def build(self, cells: Sequence[Cell], control: Control) -> EnvBase:
        """See `cavbench.driving.DrivingWorld.build`.

        Raises:
            UserError: if SUMO is not installed, or cannot start.
        """
        # Imported here because it loads torchrl and numba, which `bench list` must not load.
        from cavbench.envs.sumo.environment import SumoEnv

        return SumoEnv(self.configuration(cells, control), self.scene(), self.processes)


@dataclass(frozen=True, kw_only=True)
class SumoWorld(SumoTraffic):
    """A motorway with an on-ramp, in traffic of SUMO 1.28 (Krauss and EIDM, sublane changes), 67 ms a decision, for 30.15 s.

    Features, actions and motion of the ego are those of `highway`. The lane of the ramp is no part of the road. It needs
    pip install 'cavbench[sumo]'.
    """

    name: ClassVar[str] = SUMO_V1.world
    axes: ClassVar[Axes] = SUMO
    grid: ClassVar[str] = SUMO_V1.name
    features: ClassVar[Features] = STANDARD_FEATURES
    home: ClassVar[Cell] = SUMO.cell(lanes=3, density=1.0)
    longest: ClassVar[int] = int((LENGTH - START) / (KINEMATICS["top_speed"] * PERIOD_MS / 1000))
    rewarded: ClassVar[tuple[float, float]] = (20.0, 30.0)

    @property
    def kinematics(self) -> Kinematics:
        constants: dict[str, Any] = {**KINEMATICS, "following": FOLLOWING}
        return Kinematics(frames=1, target_speeds=self.target_speeds, **constants)

    def dynamics(self, cells: Sequence[Cell], action_type: ActionType) -> Dynamics:
        """See `cavbench.driving.DrivingWorld.dynamics`: those of `highway`. SUMO cannot be copied in the middle of an episode."""
        from cavbench.envs.highway.forecast import HighwayDynamics

        return HighwayDynamics(self.configuration(cells, Control(action_type=action_type)))

    def scene(self) -> Scene:
        """A motorway."""
        from cavbench.envs.sumo.engine import Scene

        return Scene(layout="motorway", road=lambda cell: Road(cell.lanes), start=start)
