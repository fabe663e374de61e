"""The world `recorded`: real roads with recorded traffic."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

from annotated_types import Interval

from cavbench import bounded
from cavbench.driving import ActionType, Control, DrivingFacts, Dynamics, Kinematics
from cavbench.driving.kinematics import CarFollowing
from cavbench.envs.highway.config import KINEMATICS
from cavbench.envs.recorded.axes import OWN, OWN_V1, RECORDED, RECORDED_V1, SCENES
from cavbench.envs.roads.config import Scene, TaskKind
from cavbench.envs.roads.network import Network, record, straight
from cavbench.envs.roads.recordings import Reaction
from cavbench.envs.roads.state import Measure
from cavbench.envs.roads.world import RoadsWorld
from cavbench.errors import UserError
from cavbench.scenarios import Axes, Cell, Grid
from cavbench.zoo import fetch

SPEEDS = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0)
"""Those of `highway` and lower ones: recorded traffic stops."""
IDM = (1.5, 2.0, 7.0)
"""Acceleration and braking in m/s2 and distance of centres in m of the Intelligent Driver Model, for a car of 5 m."""
TIME_GAP, FREE_SHARE = 1.5, 0.5
"""Its time gap in s, and the share of the free acceleration that is left in traffic."""
LANE_WIDTH = 3.4
"""About that of the lanes of US-101, where no scene is named; in a cell it is that of its road."""


@dataclass(frozen=True, kw_only=True)
class RecordedWorld(RoadsWorld):
    """Real roads with recorded traffic: NGSIM scenes, or a file of one's own in CommonRoad's XML; 15 Hz, six seconds.

    Args:
        change: the ego takes the place of a car whose driver changed the speed by so many m/s within the episode (default 3): who
            keeps the speed is then too fast or too slow. 0 takes every car.
        path: a scene of one's own, for scene=own: a file of CommonRoad 2020a or 2018b.
        sha256: of that file; filled in, so that records name what was driven. Another one is refused.

    Raises:
        ValueError: if a value is not allowed, or the file cannot be read; the message is one line.
    """

    name: ClassVar[str] = RECORDED_V1.world
    axes: ClassVar[Axes] = RECORDED
    grid: ClassVar[str] = RECORDED_V1.name
    redraws: ClassVar[bool] = False
    home: ClassVar[Cell] = RECORDED.cell(scene="us101_23_1")
    rules: ClassVar[Mapping[str, Any]] = {"task": TaskKind.RECORDED, "progress": Measure.PACE, "idm": IDM}

    target_speeds: tuple[float, ...] = SPEEDS
    max_steps: int = 90
    change: Annotated[float, Interval(ge=0, le=30)] = 3.0
    path: str = ""
    sha256: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.path:
            return
        try:
            found = bounded.sha256(self._own, most=bounded.TEXT, name=f"world.path={self.path}")
        except UserError as error:
            raise ValueError(str(error)) from None
        if self.sha256 not in ("", found):
            raise ValueError(
                f"{self.path} is another file than world.sha256={self.sha256[:12]} says: it has {found[:12]}"
            )
        object.__setattr__(self, "sha256", found)

    @property
    def _own(self) -> Path:
        return Path(self.path).expanduser()

    def own_grid(self) -> Grid | None:
        return OWN_V1 if self.path else None

    def sketch(self) -> Scene:
        network = Network()
        network.add("a", "b", straight([0, 0], [100, 0], width=LANE_WIDTH))
        return Scene(road=record(network), capacity=1)

    @property
    def kinematics(self) -> Kinematics | None:
        frames = self.simulation_frequency // self.policy_frequency
        following = CarFollowing(
            acceleration=IDM[0], braking=IDM[1], jam_distance=IDM[2], time_gap=TIME_GAP, free_share=FREE_SHARE
        )
        constants = {**KINEMATICS, "lane_width": LANE_WIDTH, "start_speed": None, "following": following}
        return Kinematics(frames=frames, target_speeds=self.target_speeds, **constants)

    def facts_at(self, cell: Cell) -> DrivingFacts:
        found = super().facts_at(cell)
        assert found.kinematics is not None
        width = float(self.scene(cell).road[0]["lanes"][0]["width"])
        return replace(found, kinematics=replace(found.kinematics, lane_width=width))

    def scene(self, cell: Cell) -> Scene:
        """See `RoadsWorld.scene`.

        Raises:
            UserError: in one line, if the scene is not here, or cannot be driven.
        """
        from cavbench.envs.recorded.stages import staged

        path, sha256 = self._file(cell.scene)
        found = staged(path, sha256, self.simulation_frequency, self.max_steps / self.policy_frequency, self.change)
        return Scene(
            road=found.road,
            recordings=found.recordings,
            reaction=Reaction[cell.traffic.upper()],
            capacity=len(found.recordings.tracks) + 1,
        )

    def _file(self, name: str) -> tuple[Path, str]:
        """The file of a scene, and its sha256."""
        if (name == OWN) != bool(self.path):
            raise UserError(
                f"world.path={self.path} is the scene own, and scene={name} is another one: leave out one of them"
                if self.path
                else "scene=own is a file of yours: give it as world.path=FILE (CommonRoad 2020a, XML)"
            )
        if name == OWN:
            return self._own, self.sha256
        file = SCENES[name]
        path, part = next((path, part) for path, part in fetch.places("ngsim").items() if path.name == file)
        if not path.is_file():
            raise UserError(f"the scene {name} of world recorded is not here: `bench fetch ngsim` brings it")
        return path, part.sha256

    def dynamics(self, cells: Sequence[Cell], action_type: ActionType) -> Dynamics:
        """See `cavbench.driving.DrivingWorld.dynamics`. Nothing of a recording is told."""
        # Imported here because it loads torch and numba, which `bench list` must not load.
        from cavbench.envs.recorded.foresight import RecordedDynamics

        return RecordedDynamics(self.config(cells, Control(action_type=action_type)))

    def scenarios(self, cell: Cell) -> int | None:
        """See `World.scenarios`: one for each start."""
        return len(self.scene(cell).recordings.starts)

    def doubts(self, cells: Sequence[Cell]) -> Sequence[str]:
        # It is called before anything is driven, so a scene that is missing or unfit is named then.
        for cell in dict.fromkeys(cell.replaced(weather="clear") for cell in cells):
            self.scene(cell)
        return ()
