"""The batched engine of the world `platoon`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cavbench.driving.features import ActionType, Driver
from cavbench.envs.platoon import kernels
from cavbench.envs.platoon.axes import CYCLES
from cavbench.envs.platoon.cycles import plan
from cavbench.envs.platoon.motion import ACC, AGENT, BRAKING, CACC, CLAIRVOYANT, IDM
from cavbench.envs.platoon.state import Flags, Floats, Platoons, Rules
from cavbench.scenarios import Cell

DRIVERS = {"agent": AGENT, "idm": IDM, "clairvoyant": CLAIRVOYANT}
LAWS = {"cacc": CACC, "acc": ACC, "idm": IDM}
COMMANDS = (-8.0, -2.0, 0.0, 0.7, 2.0)
"""Commands of the discrete actions in m/s2."""
WIDTH = 5
"""Columns of an observation: presence and the features."""


@dataclass(frozen=True, kw_only=True)
class PlatoonConfig:
    """The configuration of B platoons; the fields are those of the world and of `cavbench.driving.Control`."""

    cells: tuple[Cell, ...]
    followers: str = "cacc"
    headway: float = 0.7
    behind: int = 2
    senders: int = 8
    noise: float = 1.0
    max_steps: int = 600
    action_type: ActionType = "discrete"
    driver: Driver = "agent"
    action_repeat: int = 1
    traffic: None = None

    @property
    def batch(self) -> int:
        """B."""
        return len(self.cells)

    @property
    def observed_vehicles(self) -> int:
        """V: the car itself, its radar, and the senders."""
        return 2 + self.senders

    @cached_property
    def rules(self) -> Rules:
        """As the compiled code takes them."""
        ego, law = DRIVERS[self.driver], LAWS[self.followers]
        return Rules(ego, law, float(self.headway), float(self.noise), self.action_repeat, self.max_steps)


class PlatoonEngine:
    """B platoons.

    Attributes:
        platoons: their state.
        observation: float32 [B, V, 5].
        numbers: [B, kernels.COLUMNS] of the last decision.
    """

    def __init__(self, config: PlatoonConfig) -> None:
        self.config = config
        places = np.array([int(cell["place"]) for cell in config.cells])
        cars = places + 1 + config.behind
        self.platoons = Platoons.empty(config.batch, int(cars.max()), config.max_steps)
        self.platoons.place[:], self.platoons.cars[:] = places, cars
        self.platoons.loss[:] = [float(cell["loss"]) for cell in config.cells]
        self.cycles = np.array([CYCLES.index(str(cell["cycle"])) for cell in config.cells])
        self.observation = np.zeros((config.batch, config.observed_vehicles, WIDTH), np.float32)
        self.numbers = np.zeros((config.batch, kernels.COLUMNS))
        self.numbers[:, [kernels.TTC, kernels.TIME_GAP]] = np.inf
        self.running = np.zeros(config.batch, np.bool_)

    def reset(self, chosen: NDArray[np.int64], seeds: NDArray[np.int64]) -> None:
        """Start the platoons `chosen` [R] from scenario seeds [R]."""
        commands, speeds = np.zeros((len(chosen), self.config.max_steps)), np.zeros(len(chosen))
        plan(seeds, self.cycles[chosen], commands, speeds)
        self.platoons.leader[chosen], self.platoons.seed[chosen] = commands, seeds
        kernels.start(self.platoons, chosen, speeds, self.config.rules)
        self.numbers[chosen] = 0.0
        self.numbers[chosen, kernels.SPEED] = speeds
        self.numbers[chosen, kernels.X] = self.platoons.x[chosen, self.platoons.place[chosen]]
        for column in (kernels.TTC, kernels.TIME_GAP):
            self.numbers[chosen, column] = np.inf
        self.look()

    def step(self, action: NDArray[np.generic], paused: Flags | None = None) -> None:
        """Drive actions [B], numbers of the discrete ones, or continuous ones [B, 1] in [-1, 1]."""
        paused = self.running if paused is None else paused
        kernels.step(self.platoons, self.commands(action), paused, self.config.rules, self.numbers)
        self.look()

    def look(self) -> None:
        """Write the observation."""
        kernels.look(self.platoons, self.config.rules, self.observation)

    def commands(self, action: NDArray[np.generic]) -> Floats:
        """Actions as commands in m/s2, [B]."""
        return commanded(action, self.config.action_type)


def commanded(action: NDArray[np.generic], action_type: ActionType) -> Floats:
    """Actions as commands in m/s2: int64 [B], or float [B, 1]."""
    if action_type == "discrete":
        return np.array(COMMANDS)[action.astype(np.int64)]
    return np.asarray(action, dtype=np.float64).reshape(len(action)).clip(-1, 1) * BRAKING
