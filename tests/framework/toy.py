"""A third party's plug-ins as small as they can be: a world of ten steps, a victim with weights, and attacks of every temper."""

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

from bench.driving import (
    ActionType,
    Driver,
    DrivingAttack,
    DrivingDefense,
    DrivingVictim,
    DrivingWorld,
    Features,
    Oracle,
    Policy,
)
from bench.plugins.contracts import Access, Progress, Trained
from bench.scenarios import Cell

FLAGS = ("crashed", "offroad")
MEASURES = ("progress", "speed", "x", "ttc")


class ToyEnv(EnvBase):
    """Each episode counts down; its observation and rewards depend on its seed, its lanes and the actions taken."""

    def __init__(self, cells: Sequence[Cell], action_type: ActionType, steps: int) -> None:
        size = len(cells)
        super().__init__(batch_size=[size])
        self.lanes = torch.tensor([float(cell.lanes) for cell in cells])
        self.discrete, self.steps = action_type == "discrete", steps
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
        self.action_spec = Categorical(5, (size,)) if self.discrete else Bounded(-1.0, 1.0, (size, 2))

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        seeds = tensordict["seed"] if tensordict is not None else torch.zeros(self.batch_size, dtype=torch.int64)
        self.place = (seeds % 97).float() / 97 + self.lanes
        self.time = 0
        return self._state(torch.zeros(self.batch_size))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict["action"].float()
        push = action / 4 if self.discrete else action[..., 0]
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
    """Ten steps of nothing much.

    Args:
        max_steps: of an episode.
    """

    features: ClassVar[Features] = Features(names=("x", "vx"), low=(-10.0, -5.0), high=(10.0, 5.0), units=("m", "m/s"))
    max_steps: int = 10

    def make(
        self,
        cells: Sequence[Cell],
        *,
        action_type: ActionType = "discrete",
        driver: Driver = "agent",
        action_repeat: int = 1,
    ) -> EnvBase:
        return ToyEnv(cells, action_type, self.max_steps)


class ToyPolicy(Policy):
    """A linear policy with weights drawn from its seed."""

    def __init__(self, action_type: ActionType, seed: int) -> None:
        super().__init__()
        self.action_type, self.shape = action_type, {"action_type": action_type, "seed": seed}
        weights = torch.randn(6, 5 if action_type == "discrete" else 2, generator=torch.Generator().manual_seed(seed))
        self.register_buffer("weights", weights)

    def scores(self, observation: Tensor) -> Tensor:
        return (observation.flatten(-2) @ self.weights).tanh()


@dataclass(frozen=True, kw_only=True)
class ToyVictim(DrivingVictim):
    """A driver that learned from nobody.

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

    def load(self, seed: int) -> Policy:
        return ToyPolicy(self.actions, seed)

    def train(self, world: DrivingWorld, *, seed: int, hooks: object = None, progress: Progress) -> Trained[Policy]:
        progress(0.5, "half way")
        progress(1.0, "there")
        return Trained(ToyPolicy(self.actions, seed), {"world": type(world).__name__})


@dataclass(frozen=True, kw_only=True)
class Nudge(DrivingAttack):
    """Pushes everything by a random sign.

    Args:
        scale: share of the radius.
        pause: seconds to sleep at every step.
        mood: what it does beside that: nothing, raise an error, or kill its own process.
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
class Steer(DrivingAttack):
    """Only for drivers that steer themselves, and only with their gradients."""

    access: ClassVar[Access] = "gradients"
    action_types: ClassVar[tuple[ActionType, ...]] = ("continuous",)

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        _, gradient = oracle.gradient(observation, lambda scores: scores.sum(-1))
        return observation + gradient.sign() * oracle.radius


@dataclass(frozen=True, kw_only=True)
class Guard(DrivingDefense):
    """Rounds what the victim sees.

    Args:
        digits: kept after the point.
    """

    digits: int

    def load(self, victim: DrivingVictim, seed: int) -> Policy:
        return _Guarded(victim.load(seed), self.digits)


class _Guarded(Policy):
    def __init__(self, policy: Policy, digits: int) -> None:
        super().__init__()
        self.policy, self.digits, self.action_type = policy, digits, policy.action_type

    def scores(self, observation: Tensor) -> Tensor:
        return self.policy.scores(observation.round(decimals=self.digits))
