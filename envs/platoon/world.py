"""The world `platoon`: a driven car in a platoon whose cars tell each other how they move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from annotated_types import Interval

from cavbench.core.ranges import Natural, NotNegative
from cavbench.driving import ActionType, Control, Driver, DrivingFacts, DrivingWorld, Dynamics, Features
from cavbench.driving.features import LaneShape
from cavbench.driving.platooning import Platooning
from cavbench.envs.platoon.axes import AXES, LAST_PLACE, PLATOON_V1
from cavbench.scenarios import Axes, Cell

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

    from cavbench.envs.platoon.engine import PlatoonConfig

ACTIONS = ("BRAKE_HARD", "DECELERATE", "HOLD", "GAIN", "ACCELERATE")
FEATURES = Features(
    names=("x", "vx", "ax", "age"),
    low=(-400.0, -50.0, -10.0, 0.0),
    high=(400.0, 50.0, 10.0, 1.0),
    units=("m", "m/s", "m/s2", "s"),
    floors=(0.5, 0.3, 0.2, 0.0),
    fixed=("age",),
    messages=2,
)
"""Row 1 is the radar, the rows from 2 on are messages (`cavbench.driving.platooning.Platooning`)."""
PLATOONING = Platooning(
    acceleration=3.0, braking=8.0, lag=0.1, length=5.0, standstill=2.0, timeout=1.0, radar=1, senders=2
)
LANE = LaneShape(width=4.0, line=((-1000.0, 0.0), (10_000.0, 0.0)))


@dataclass(frozen=True, kw_only=True)
class PlatoonWorld(DrivingWorld):
    """A platoon on one lane, 10 decisions and messages a second, for 60 s. The driven car is one of its followers.

    Cars follow their commands with a lag of 0.1 s. The car ahead is measured by a radar. Every car ahead sends where it is, how
    fast it is, and the acceleration that its controller asks for. The other followers drive by `followers`, on true messages.

    Args:
        followers: controller of the other followers: `cacc` and `acc` of Ploeg et al. 2011, or `idm`.
        headway: their time gap in s, 0.3 to 4; IDM has its own, 1.5 s.
        behind: number of followers behind the driven car.
        noise: deviation of radar and satellite positions over the usual one (radar 0.1 m, 0.05 m/s; messages 0.5 m, 0.1 m/s).
        max_steps: number of decisions until an episode is truncated.

    Raises:
        ValueError: if a value is not allowed; the message is one line.
    """

    name: ClassVar[str] = PLATOON_V1.world
    axes: ClassVar[Axes] = AXES
    grid: ClassVar[str] = PLATOON_V1.name
    features: ClassVar[Features] = FEATURES
    actions: ClassVar[tuple[str, ...]] = ACTIONS
    drivers: ClassVar[tuple[Driver, ...]] = ("agent", "idm", "clairvoyant")
    offers: ClassVar[tuple[str, ...]] = ("messages", "latency", "held")
    home: ClassVar[Cell] = AXES.cell(place=2, cycle="motorway")
    """The cell that stands for the world where none is chosen."""

    followers: Literal["cacc", "acc", "idm"] = "cacc"
    headway: Annotated[float, Interval(ge=0.3, le=4)] = 0.7
    behind: Natural = 2
    noise: NotNegative = 1.0
    max_steps: Annotated[int, Interval(ge=1, le=36_000)] = 600

    @property
    def decision_hz(self) -> float:
        return 10.0

    @property
    def observed_rows(self) -> int:
        return PLATOONING.senders + LAST_PLACE

    @property
    def facts(self) -> DrivingFacts:
        return replace(
            super().facts,
            controls=("acceleration",),
            platooning=PLATOONING,
            lanes=(LANE,),
            environment=self.gym_call,
        )

    def configuration(self, cells: Sequence[Cell], control: Control | None = None) -> PlatoonConfig:
        """The configuration of the engine; arguments as in `DrivingWorld.build`."""
        from cavbench.envs.platoon.engine import PlatoonConfig

        control = control or Control()
        return PlatoonConfig(
            cells=tuple(cells),
            followers=self.followers,
            headway=self.headway,
            behind=self.behind,
            senders=LAST_PLACE,
            noise=self.noise,
            max_steps=self.max_steps,
            action_type=control.action_type,
            driver=control.driver,
            action_repeat=control.action_repeat,
        )

    def dynamics(self, cells: Sequence[Cell], action_type: ActionType) -> Dynamics:
        """See `cavbench.driving.DrivingWorld.dynamics`: the cars ahead keep their command for a second."""
        from cavbench.envs.platoon.forecast import PlatoonDynamics

        return PlatoonDynamics(len(cells), self.observed_rows, self.features, action_type)

    def build(self, cells: Sequence[Cell], control: Control) -> EnvBase:
        """See `cavbench.driving.DrivingWorld.build`."""
        # Imported here because it loads torchrl and numba, which `bench list` must not load.
        from cavbench.envs.platoon.environment import PlatoonEnv

        return PlatoonEnv(self.configuration(cells, control))
