"""The highway world and its parameters, as in `world=highway world.vehicles=50`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, get_args

from cavbench.driving import Control, Features
from cavbench.envs.highway.axes import FAST_V0, HIGHWAY_V0, STANDARD_V2
from cavbench.envs.highway.config import (
    STANDARD_FEATURES,
    STANDARD_TARGET_SPEEDS,
    THESIS_FEATURES,
    THESIS_TARGET_SPEEDS,
    WIDE_FEATURES,
    HighwayConfig,
    Preset,
    lanes_held,
)
from cavbench.envs.highway.road import Backend, StraightRoad
from cavbench.errors import UserError
from cavbench.scenarios import Cell

OTHER_FEATURES = {"thesis": THESIS_FEATURES, "wide": WIDE_FEATURES}


@dataclass(frozen=True, kw_only=True)
class HighwayWorld(StraightRoad):
    """A straight highway with IDM/MOBIL traffic: the traffic of highway-env 1.12.1's `highway-v0`, at 15 Hz, for 30 seconds.

    highway-env's own tasks, with their rates, rows, ranges and rewards, are the worlds `highway-v0` and `highway-fast-v0`.

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

    Raises:
        ValueError: if a value is not allowed; the message is one line.
    """

    name: ClassVar[str] = STANDARD_V2.world
    grid: ClassVar[str] = STANDARD_V2.name
    features: ClassVar[Features] = STANDARD_FEATURES

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
            tasks = (HIGHWAY_V0.world, FAST_V0.world)
            own = f"; highway-env's own tasks are worlds: world={self.preset}" if self.preset in tasks else ""
            raise ValueError(f"preset must be one of {', '.join(get_args(Preset))}, got {self.preset!r}{own}")
        if self.target_speeds is not None:
            # A list from a configuration file would make the world unhashable.
            object.__setattr__(self, "target_speeds", tuple(float(speed) for speed in self.target_speeds))
        if self.preset in OTHER_FEATURES:
            # The class attribute has the ranges of the standard preset.
            object.__setattr__(self, "features", OTHER_FEATURES[self.preset])
        super().__post_init__()

    @property
    def observed_rows(self) -> int:
        preset_rows = 5 if self.preset == "thesis" else 10
        return self.observed_vehicles if self.observed_vehicles is not None else preset_rows

    def configuration(self, cells: Sequence[Cell], control: Control | None = None) -> HighwayConfig:
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
            traffic=control.traffic,
            surroundings=control.surroundings,
            target_speeds=self.target_speeds if self.target_speeds is not None else preset_speeds,
            features=self.features,
            observed_vehicles=self.observed_rows,
            offroad_terminal=self.offroad_terminal,
        )

    def check_roads(self, cells: Sequence[Cell]) -> None:
        """Refuse more lanes than the range of y holds.

        Raises:
            UserError: says how many it holds.
        """
        most, held = max(cell.lanes for cell in cells), lanes_held(self.features)
        if most > held:
            raise UserError(
                f"on {most} lanes y reaches {4 * most - 2} m, but the observation of preset {self.preset} ends at "
                f"{self.features.high[1]:g} m, so that a car cannot see where the road ends: give at most {held} lanes, or write "
                "world.preset=wide (y to 32 m) with drivers that are trained in it"
            )
