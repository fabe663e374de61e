"""Minimal third-party plug-ins: a world of ten steps, a victim with weights, and attacks that misbehave on demand."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from cavbench.core.contracts import Access, Progress, Trained
from cavbench.driving import (
    ActionType,
    Control,
    DrivingAttack,
    DrivingDefense,
    DrivingFacts,
    DrivingVictim,
    DrivingWorld,
    Features,
    Oracle,
    Policy,
    PolicyWrapper,
    State,
)
from cavbench.scenarios import Axes, Axis, Cell, Grid

FLAGS = ("crashed", "offroad")
MEASURES = ("progress", "speed", "x", "ttc")

TOY_AXES = Axes(
    (
        Axis(name="lanes", kind="int", meaning="number of lanes", low=2, high=8),
        Axis(name="density", kind="float", meaning="traffic density", above=0.0, high=4.0),
        Axis(
            name="weather",
            kind="str",
            meaning="what the air is like",
            choices=("clear", "rain", "fog"),
            default="clear",
            perceptual=True,
        ),
    )
)
TOY_V1 = Grid(
    name="toy-v1",
    world="toy",
    axes=TOY_AXES,
    values={"lanes": (3, 4, 5), "density": (1.0, 2.0), "weather": ("clear", "rain", "fog")},
    episodes=100,
)
BEND_AXES = Axes(
    (
        Axis(name="curvature", kind="float", meaning="of the road", unit="1/m", low=0.0, high=1.0),
        Axis(name="gap", kind="int", meaning="to the car ahead when an episode begins", unit="m", low=1),
    )
)
BEND_V1 = Grid(
    name="bend-v1", world="bend", axes=BEND_AXES, values={"curvature": (0.0, 0.1, 0.2), "gap": (20, 40)}, episodes=4
)


class ToyEnv(EnvBase):
    """Each episode counts down; its observation and rewards depend on its seed, its cell and the actions taken.

    Args:
        cells: of the episodes; the numbers on their axes count.
        actions: discrete ones; 0 for continuous ones.
        steps: of an episode.
    """

    def __init__(self, cells: Sequence[Cell], actions: int, steps: int) -> None:
        size = len(cells)
        super().__init__(batch_size=[size])
        numbers = [sum(float(value) for value in cell.values() if not isinstance(value, str)) for cell in cells]
        self.offset, self.actions, self.steps = torch.tensor(numbers), actions, steps
        info = {name: Unbounded((size, 1)) for name in MEASURES} | {
            name: Binary(1, (size, 1), dtype=torch.bool) for name in FLAGS
        }
        self.observation_spec = Composite(
            observation=Unbounded((size, 2, 3)), info=Composite(info, shape=(size,)), shape=(size,)
        )
        self.reward_spec = Unbounded((size, 1))
        self.done_spec = Composite(
            {name: Binary(1, (size, 1), dtype=torch.bool) for name in ("done", "terminated", "truncated")},
            shape=(size,),
        )
        self.action_spec = Categorical(actions, (size,)) if actions else Bounded(-1.0, 1.0, (size, 2))

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        seeds = tensordict["seed"] if tensordict is not None else torch.zeros(self.batch_size, dtype=torch.int64)
        self.place = (seeds % 97).float() / 97 + self.offset
        self.time = 0
        return self._state(torch.zeros(self.batch_size))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict["action"].float()
        push = action / (self.actions - 1) if self.actions else action[..., 0]
        self.place, self.time = self.place + push, self.time + 1
        return self._state(push).set("reward", push[:, None])

    def _state(self, push: Tensor) -> TensorDict:
        angle = self.place[:, None] + torch.arange(4.0)
        rows = angle.sin().reshape(-1, 2, 2) / 2
        measured = dict.fromkeys(MEASURES, push[:, None]) | dict.fromkeys(FLAGS, (push < -1)[:, None])
        over = torch.full((*self.batch_size, 1), self.time >= self.steps)
        return TensorDict(
            {
                "observation": torch.cat((torch.ones_like(rows[..., :1]), rows), -1),
                "info": TensorDict(measured, self.batch_size),
                "done": over,
                "truncated": over.clone(),
                "terminated": torch.zeros_like(over),
            },
            self.batch_size,
        )

    def _set_seed(self, seed: int | None) -> None:
        pass


@dataclass(frozen=True, kw_only=True)
class ToyWorld(DrivingWorld):
    """Ten simple steps, on the axes of a highway.

    Args:
        max_steps: of an episode.
    """

    axes: ClassVar[Axes] = TOY_AXES
    grid: ClassVar[str] = TOY_V1.name
    features: ClassVar[Features] = Features(names=("x", "vx"), low=(-10.0, -5.0), high=(10.0, 5.0), units=("m", "m/s"))
    actions: ClassVar[tuple[str, ...]] = ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER")
    max_steps: int = 10

    @property
    def decision_hz(self) -> float:
        return 10.0

    def build(self, cells: Sequence[Cell], control: Control) -> EnvBase:
        return ToyEnv(cells, len(self.actions) if control.action_type == "discrete" else 0, self.max_steps)


@dataclass(frozen=True, kw_only=True)
class BendWorld(ToyWorld):
    """Ten steps on a bend at 5 Hz, with other axes and three actions."""

    axes: ClassVar[Axes] = BEND_AXES
    grid: ClassVar[str] = BEND_V1.name
    actions: ClassVar[tuple[str, ...]] = ("LEFT", "STRAIGHT", "RIGHT")

    @property
    def decision_hz(self) -> float:
        return 5.0


class ToyPolicy(Policy):
    """A linear policy with weights drawn from its seed.

    Args:
        action_type: what it decides.
        seed: of its weights.
        actions: discrete ones.
    """

    def __init__(self, action_type: ActionType, seed: int, actions: int = 5) -> None:
        super().__init__()
        self.action_type, self.shape = action_type, {"action_type": action_type, "seed": seed, "actions": actions}
        width = actions if action_type == "discrete" else 2
        self.register_buffer("weights", torch.randn(6, width, generator=torch.Generator().manual_seed(seed)))

    def forward(self, observation: Tensor) -> Tensor:
        return (observation.flatten(-2) @ self.weights).tanh()


@dataclass(frozen=True, kw_only=True)
class ToyVictim(DrivingVictim):
    """A policy that is not trained.

    Args:
        actions: what it decides.
        trained_in: the world it was trained in.
    """

    learns: ClassVar[bool] = True
    actions: Literal["discrete", "continuous"] = "discrete"
    trained_in: str = ""

    @property
    def action_type(self) -> ActionType:
        return self.actions

    def zoo_name(self) -> str:
        return f"toy-{self.actions}"

    def load(self, seed: int, facts: DrivingFacts) -> Policy:
        return ToyPolicy(self.actions, seed, len(facts.actions)).eval()

    def train(self, world: DrivingWorld, *, seed: int, hooks: object = None, progress: Progress) -> Trained[Policy]:
        progress(0.5, "half way")
        progress(1.0, "there")
        return Trained(ToyPolicy(self.actions, seed, len(world.actions)), {"world": type(world).__name__})


@dataclass(frozen=True, kw_only=True)
class Nudge(DrivingAttack):
    """Moves every value by the radius with a random sign.

    Args:
        scale: share of the radius.
        pause: seconds to sleep at every step.
        mood: misbehaviour: none, raise an error, or kill its process.
    """

    access: ClassVar[Access] = "oblivious"
    scale: float = 1.0
    pause: float = 0.0
    mood: Literal["calm", "raise", "kill"] = "calm"

    def __post_init__(self) -> None:
        if not 0 < self.scale <= 1:
            raise ValueError(f"scale must be in (0, 1], got {self.scale}")

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        if self.mood == "raise":
            raise ZeroDivisionError("the attack is at a loss")
        if self.mood == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(self.pause)
        sign = torch.randint(0, 2, observation.shape, generator=oracle.generator) * 2 - 1
        return observation + self.scale * sign * oracle.radius


@dataclass(frozen=True, kw_only=True)
class Veer(DrivingAttack):
    """An attack for continuous actions that needs gradients."""

    access: ClassVar[Access] = "gradients"
    action_types: ClassVar[tuple[ActionType, ...]] = ("continuous",)

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        _, gradient = oracle.gradient(observation, lambda scores: scores.sum(-1))
        return observation + gradient.sign() * oracle.radius


@dataclass(frozen=True, kw_only=True)
class Guard(DrivingDefense):
    """Rounds the observation.

    Args:
        digits: kept after the point.
    """

    digits: int

    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        return _Guarded(victim.load(seed, facts), self.digits)


class _Guarded(PolicyWrapper):
    def __init__(self, policy: Policy, digits: int) -> None:
        super().__init__(policy)
        self.digits = digits

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        return self.policy.scores(observation.round(decimals=self.digits), state)
