"""The highway world and its parameters, as in `world=highway world.vehicles=50`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import TYPE_CHECKING, ClassVar, Literal, get_args

from cavbench.core.parameters import differing
from cavbench.driving import ActionType, Control, Driver, DrivingFacts, DrivingWorld, Dynamics, Features, Kinematics
from cavbench.envs.highway.axes import AXES, STANDARD_V2
from cavbench.envs.highway.config import (
    ACTIONS,
    KINEMATICS,
    STANDARD_FEATURES,
    STANDARD_TARGET_SPEEDS,
    THESIS_FEATURES,
    THESIS_TARGET_SPEEDS,
    WIDE_FEATURES,
    HighwayConfig,
    Preset,
    lanes_held,
)
from cavbench.errors import UserError
from cavbench.scenarios import Axes, Cell

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

Backend = Literal["batched", "reference"]
OTHER_FEATURES = {"thesis": THESIS_FEATURES, "wide": WIDE_FEATURES}
BUSY = 2.0
"""Above this density cars crash at the start whoever drives."""
REFERENCE = "highway-env"
"""The distribution that the backend `reference` needs."""


@dataclass(frozen=True, kw_only=True)
class HighwayWorld(DrivingWorld):
    """A straight highway with IDM/MOBIL traffic: highway-env 1.12.1's `highway-v0`, 15 Hz, 30 seconds.

    Args:
        preset: `standard` (x +-100 m, y +-20 m, vx +-40 m/s, vy +-20 m/s, 10 rows, target speeds 10 to 30 by 5; up to 5 lanes),
            `wide` (the same with y +-32 m, for up to 8 lanes) or `thesis` (x, y +-100 m, velocities 0 to 20 m/s, 5 rows, target
            speeds 20, 25, 30).
        vehicles: number of traffic vehicles besides the ego.
        observed_vehicles: number of rows in an observation, including the ego; None for the preset's.
        target_speeds: speeds in m/s for FASTER and SLOWER; None for the preset's.
        simulation_frequency, policy_frequency: physics frames and decisions per second.
        max_steps: number of decisions until an episode is truncated.
        offroad_terminal: whether leaving the road ends the episode.
        backend: `batched`, our engine, or `reference`, the real highway-env (identical results, several hundred times slower;
            needs pip install 'cavbench[reference]').

    Raises:
        ValueError: if a value is not allowed; the message is one line.
    """

    axes: ClassVar[Axes] = AXES
    grid: ClassVar[str] = STANDARD_V2.name
    features: ClassVar[Features] = STANDARD_FEATURES
    actions: ClassVar[tuple[str, ...]] = ACTIONS
    drivers: ClassVar[tuple[Driver, ...]] = ("agent", "idm", "clairvoyant")

    preset: Preset = "standard"
    vehicles: int = 20
    observed_vehicles: int | None = None
    target_speeds: tuple[float, ...] | None = None
    simulation_frequency: int = 15
    policy_frequency: int = 15
    max_steps: int = 450
    offroad_terminal: bool = True
    backend: Backend = "batched"

    def __post_init__(self) -> None:
        if self.preset not in get_args(Preset):
            raise ValueError(f"preset must be one of {', '.join(get_args(Preset))}, got {self.preset!r}")
        if self.backend not in get_args(Backend):
            raise ValueError(f"backend must be one of {', '.join(get_args(Backend))}, got {self.backend!r}")
        if self.target_speeds is not None:
            # A list from a configuration file would make the world unhashable.
            object.__setattr__(self, "target_speeds", tuple(float(speed) for speed in self.target_speeds))
        if self.preset in OTHER_FEATURES:
            # The class attribute has the ranges of the standard preset.
            object.__setattr__(self, "features", OTHER_FEATURES[self.preset])
        if self.backend == "reference":
            if find_spec("highway_env") is None:
                raise ValueError(f"backend=reference needs {REFERENCE}: pip install 'cavbench[reference]'")
            object.__setattr__(self, "libraries", (REFERENCE,))
            # The planner copies the state of our engine.
            object.__setattr__(self, "drivers", ("agent", "idm"))
        self.config((AXES.cell(lanes=3, density=1.0),))

    @property
    def decision_hz(self) -> float:
        return self.policy_frequency

    @property
    def kinematics(self) -> Kinematics:
        config = self.config((AXES.cell(lanes=3, density=1.0),))
        return Kinematics(frames=config.substeps, target_speeds=config.target_speeds, **KINEMATICS)

    @property
    def observed_rows(self) -> int:
        preset_rows = 5 if self.preset == "thesis" else 10
        return self.observed_vehicles if self.observed_vehicles is not None else preset_rows

    @property
    def facts(self) -> DrivingFacts:
        options = "".join(f", {name}={value!r}" for name, value in differing(self).items())
        return replace(super().facts, environment=f'cavbench.gym.make("highway"{options})')

    def config(self, cells: Sequence[Cell], control: Control | None = None) -> HighwayConfig:
        """The environment's full configuration; arguments as in `DrivingWorld.build`."""
        thesis, control = self.preset == "thesis", control or Control()
        preset_speeds = THESIS_TARGET_SPEEDS if thesis else STANDARD_TARGET_SPEEDS
        return HighwayConfig(
            cells=tuple(cells),
            vehicles=self.vehicles,
            simulation_frequency=self.simulation_frequency,
            policy_frequency=self.policy_frequency,
            max_steps=self.max_steps,
            action_type=control.action_type,
            driver=control.driver,
            action_repeat=control.action_repeat,
            target_speeds=self.target_speeds if self.target_speeds is not None else preset_speeds,
            features=self.features,
            observed_vehicles=self.observed_rows,
            offroad_terminal=self.offroad_terminal,
        )

    def doubts(self, cells: Sequence[Cell]) -> Sequence[str]:
        """Whether the observation holds all lanes, and whether the traffic leaves a way through.

        Raises:
            UserError: if there are more lanes than the range of y holds.
        """
        self._check_lanes(cells)
        densest = max(cell.density for cell in cells)
        if densest <= BUSY:
            return ()
        return [
            f"density {densest:g} makes crashes without any attack: highway-env's own IDM driver crashes in 11 % of the episodes "
            f"at 3 and in 26 % at 4, a car that only brakes in 22 % and 56 %; at {BUSY:g} in 0 % and 2 %"
        ]

    def _check_lanes(self, cells: Sequence[Cell]) -> None:
        most, held = max(cell.lanes for cell in cells), lanes_held(self.features)
        if most > held:
            raise UserError(
                f"on {most} lanes y reaches {4 * most - 2} m, but the observation of preset {self.preset} ends at "
                f"{self.features.high[1]:g} m, so that a car cannot see where the road ends: give at most {held} lanes, or write "
                "world.preset=wide (y to 32 m) with drivers that are trained in it"
            )

    def dynamics(self, cells: Sequence[Cell], action_type: ActionType) -> Dynamics:
        """See `cavbench.driving.DrivingWorld.dynamics`; on the compiled engine for both backends."""
        from cavbench.envs.highway.forecast import HighwayDynamics

        return HighwayDynamics(self.config(cells, Control(action_type=action_type)))

    def build(self, cells: Sequence[Cell], control: Control) -> EnvBase:
        """See `cavbench.driving.DrivingWorld.build`.

        Raises:
            UserError: if there are more lanes than the range of y holds.
        """
        self._check_lanes(cells)
        config = self.config(cells, control)
        # Imported here because both load torchrl and numba or pygame, which `bench list` must not load.
        if self.backend == "batched":
            from cavbench.envs.highway.batched import BatchedHighway

            return BatchedHighway(config)
        from cavbench.envs.highway.reference import ReferenceHighway

        return ReferenceHighway(config)
