"""What all worlds on highway-env's straight road have in common: the two environments, and the rules of motion."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.util import find_spec
from typing import TYPE_CHECKING, ClassVar, Literal, get_args

from cavbench.driving import ActionType, Control, Driver, DrivingFacts, DrivingWorld, Dynamics, Kinematics
from cavbench.envs.highway.axes import AXES
from cavbench.envs.highway.config import ACTIONS, KINEMATICS, HighwayConfig
from cavbench.scenarios import Axes, Cell

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from torchrl.envs import EnvBase

    from cavbench.driving.blame import Deeds

Backend = Literal["batched", "reference"]
BUSY = 2.0
"""Above this density cars crash at the start whoever drives."""
REFERENCE = "highway-env"
"""The distribution that the backend `reference` needs."""


class StraightRoad(DrivingWorld):
    """A straight highway with IDM/MOBIL traffic. Worlds are dataclasses derived from it, with a field `backend`.

    Args:
        backend: `batched`, our engine, or `reference`, the real highway-env (identical results, several hundred times slower;
            needs pip install 'cavbench[reference]').
    """

    axes: ClassVar[Axes] = AXES
    actions: ClassVar[tuple[str, ...]] = ACTIONS
    drivers: ClassVar[tuple[Driver, ...]] = ("agent", "idm", "clairvoyant")
    home: ClassVar[Cell] = AXES.cell(lanes=3, density=1.0)
    """The cell that stands for the world where none is chosen."""
    offers: ClassVar[tuple[str, ...]] = (*DrivingWorld.offers, "traffic", "dynamics")
    backend: Backend

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.backend not in get_args(Backend):
            raise ValueError(f"backend must be one of {', '.join(get_args(Backend))}, got {self.backend!r}")
        if self.backend == "reference":
            if find_spec("highway_env") is None:
                raise ValueError(f"backend=reference needs {REFERENCE}: pip install 'cavbench[reference]'")
            object.__setattr__(self, "libraries", (REFERENCE,))
            # The planner copies the state of our engine.
            object.__setattr__(self, "drivers", ("agent", "idm"))
            object.__setattr__(self, "offers", DrivingWorld.offers)
        self.configuration((self.home,))

    @abstractmethod
    def configuration(self, cells: Sequence[Cell], control: Control | None = None) -> HighwayConfig:
        """The environment's full configuration; arguments as in `DrivingWorld.build`."""

    @property
    def decision_hz(self) -> float:
        return self.configuration((self.home,)).policy_frequency

    @property
    def kinematics(self) -> Kinematics:
        config = self.configuration((self.home,))
        return Kinematics(frames=config.substeps, target_speeds=config.target_speeds, **KINEMATICS)

    @property
    def facts(self) -> DrivingFacts:
        return replace(super().facts, environment=self.gym_call)

    def doubts(self, cells: Sequence[Cell]) -> Sequence[str]:
        """Whether the traffic leaves a way through.

        Raises:
            UserError: if the world cannot be driven in these cells.
        """
        self.check_roads(cells)
        densest = max(cell.density for cell in cells)
        if densest <= BUSY:
            return ()
        return [
            f"density {densest:g} makes crashes without any attack: highway-env's own IDM driver crashes in 11 % of the episodes "
            f"at 3 and in 26 % at 4, a car that only brakes in 22 % and 56 %; at {BUSY:g} in 0 % and 2 %"
        ]

    def check_roads(self, cells: Sequence[Cell]) -> None:
        """Refuse roads on which the world cannot be driven.

        Raises:
            UserError: says which, and why.
        """

    def dynamics(self, cells: Sequence[Cell], action_type: ActionType) -> Dynamics:
        """See `cavbench.driving.DrivingWorld.dynamics`; on the compiled engine for both backends."""
        from cavbench.envs.highway.forecast import HighwayDynamics

        return HighwayDynamics(self.configuration(cells, Control(action_type=action_type)))

    def blame(
        self,
        cells: Sequence[Cell],
        control: Control,
        deeds: Deeds,
        decisions: NDArray[np.int64],
        crashed: NDArray[np.bool_],
    ) -> Mapping[str, NDArray[np.float64]]:
        """See `cavbench.driving.DrivingWorld.blame`."""
        from cavbench.envs.highway.blame import blame

        return blame(self.configuration(cells, control), deeds, decisions, crashed)

    def build(self, cells: Sequence[Cell], control: Control) -> EnvBase:
        """See `cavbench.driving.DrivingWorld.build`.

        Raises:
            UserError: if the world cannot be driven in these cells.
        """
        self.check_roads(cells)
        config = self.configuration(cells, control)
        # Imported here because both load torchrl and numba or pygame, which `bench list` must not load.
        if self.backend == "batched":
            from cavbench.envs.highway.batched import BatchedHighway

            return BatchedHighway(config)
        from cavbench.envs.highway.reference import ReferenceHighway

        return ReferenceHighway(config)
