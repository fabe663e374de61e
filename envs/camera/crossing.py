"""The crossing as a component: one road with frames close together, on which a detector drives a car in closed loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

import numpy as np
from torch import Tensor

from cavbench.detection import Approach, Scenes
from cavbench.detection.closed_loop import Plan
from cavbench.detection.stopping import REACTION_S
from cavbench.envs.camera import bank, poses
from cavbench.envs.camera.bank import BankScenes
from cavbench.envs.camera.bank_world import BankWorld
from cavbench.envs.camera.braking import brakes_in
from cavbench.envs.camera.crossing_axes import AXES, CROSSING_V2
from cavbench.envs.camera.environment import CAR_M, ApproachEnv
from cavbench.envs.camera.poses import Pose
from cavbench.envs.camera.street import layout
from cavbench.envs.camera.street.vehicles import footprint
from cavbench.envs.camera.windscreen import WindscreenScenes
from cavbench.envs.camera.world import StopSignApproach
from cavbench.envs.weather import WEATHERS
from cavbench.errors import UserError
from cavbench.scenarios import Axes, Cell

PLACE = layout.LOCATIONS["crossing"]


@dataclass(frozen=True, kw_only=True)
class StopSignCrossing(BankWorld):
    """A car driven by the detector up to a stop sign, in closed loop: it stops at the line, or crosses a road with traffic.

    Args:
        bank: folder of the rendered frames; empty for the shipped frames.
        reaction: time after which the cross traffic brakes for a car that does not stop, in s, from 0 to 100. Beyond 20 nobody
            reacts, because an episode is over before.
    """

    title: ClassVar[str] = "crossing"
    axes: ClassVar[Axes] = AXES
    grid: ClassVar[str] = CROSSING_V2.name
    locations: ClassVar[tuple[str, ...]] = (PLACE.name,)
    mounts: ClassVar[bool] = False

    reaction: float = REACTION_S

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.reaction <= 100:
            raise ValueError(f"crossing.reaction must be from 0 to 100 s, got {self.reaction:g}")

    def training_scenes(self) -> Scenes:
        """Those of the world `camera`."""
        return StopSignApproach().training_scenes()

    def scenarios(self, cell: Cell) -> int | None:
        """See `World.scenarios`: every seed has another cross traffic."""
        return None

    def approaches(self, cell: Cell, seeds: range) -> list[Approach]:
        """All seeds of a weather and a lens have the same frames; they differ in the cross traffic."""
        scenes = _scenes(self.folder, str(cell.weather), str(cell.lens))
        return [Approach(seed=seed, location=PLACE.name, scenes=scenes) for seed in seeds]

    def environment(self, cell: Cell, seeds: Sequence[int], patch: Tensor | None, share: float) -> ApproachEnv:
        return ApproachEnv(
            [_scenes(self.folder, str(cell.weather), str(cell.lens))],
            None if patch is None else patch.unsqueeze(0),
            share,
            speed=float(cell.speed),
            brakes=brakes_in(WEATHERS[str(cell.weather)]),
            reaction_s=self.reaction,
            seeds=seeds,
            plan=_plan(),
        )

    def every_pose(self) -> tuple[Pose, ...]:
        return poses.closed_loop()


@lru_cache(maxsize=4)
def _scenes(folder: Path, weather: str, lens: str) -> Scenes:
    if lens != "clean":
        street = _scenes(folder, weather, "clean")
        assert isinstance(street, BankScenes)
        return WindscreenScenes(street, [lens] * len(street))
    frames = bank.read(folder, PLACE.name, weather)
    if not frames:
        raise UserError(f"no frames of {PLACE.name} in {weather} in {folder}; `bench render` makes them")
    return BankScenes(frames, [weather] * len(frames))


def _plan() -> Plan:
    """The roads, the line and the waiting vehicles from above."""
    left, right = layout.LEFT_EDGE, layout.right_edge(poses.CLOSED_LOOP_LANES)
    (near, far), away = layout.CROSSING, 200.0
    waiting = []
    for placed in layout.traffic(PLACE, poses.CLOSED_LOOP_LANES, poses.CLOSED_LOOP_DENSITY):
        rear, front, half = footprint(placed.model)
        waiting.append((placed.x - half, placed.y + rear, placed.x + half, placed.y + front))
    return Plan(
        roads=np.array([(left, -away, right, away), (-away, near, away, far)]),
        lines=np.array([(left + 0.3, 0.4, right - 0.3, 0.9)]),
        sign=(layout.sign_x(poses.CLOSED_LOOP_LANES), 0.0),
        waiting=np.array(waiting),
        car=CAR_M,
    )
