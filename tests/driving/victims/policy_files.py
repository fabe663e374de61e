"""Policies as users would save them, and what they are driven with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from cavbench.core.pair import choose
from cavbench.driving.drive import drive
from cavbench.driving.rollout import Columns
from cavbench.envs.highway.world import HighwayWorld
from cavbench.run.config import plan_of

FACTS = HighwayWorld().facts


SHORT = "lanes=3 density=2 weather=clear episodes=3 seeds=0 world.max_steps=40 reference=false"


class Scores(nn.Module):
    """The zoo's DQN as a user would export it, or a network of another width."""

    def __init__(self, outputs: int = 5, *, flat: bool = False) -> None:
        super().__init__()
        self.policy = choose("victim", "dqn").component.load(0, FACTS)
        self.outputs, self.flat = outputs, flat

    def forward(self, observation: Tensor) -> Tensor:
        observation = observation.reshape(-1, 10, 5) if self.flat else observation
        return self.policy.scores(observation)[:, : self.outputs]


class Fewer(nn.Module):
    """A network of 5 rows."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(25, 5)

    def forward(self, observation: Tensor) -> Tensor:
        return self.linear(observation.flatten(1))


def torch_file(
    path: Path, network: nn.Module | None = None, shape: tuple[int, ...] = (10, 5), *, fixed: bool = False
) -> str:
    dynamic = None if fixed else {"observation": {0: torch.export.Dim("batch")}}
    program = torch.export.export(network or Scores(), (torch.rand(3, *shape),), dynamic_shapes=dynamic)
    torch.export.save(program, path)
    return str(path)


def onnx_file(
    path: Path, network: nn.Module | None = None, shape: tuple[int, ...] = (10, 5), *, fixed: bool = False
) -> str:
    pytest.importorskip("onnxscript")
    pytest.importorskip("onnxruntime")
    dynamic = None if fixed else {"observation": {0: torch.export.Dim("batch")}}
    torch.onnx.export(
        network or Scores(),
        (torch.rand(3, *shape),),
        path,
        dynamic_shapes=dynamic,
        input_names=["observation"],
        external_data=False,
        verbose=False,
    )
    return str(path)


def spaces(
    *, continuous: bool, shape: tuple[int, ...] = (10, 5), high: float = 1.0, seen: float = 1.0
) -> gymnasium.Env[Any, Any]:
    """A dummy environment with these spaces: observations in [-seen, seen], actions in [-high, high]."""
    env: gymnasium.Env[Any, Any] = gymnasium.Env()
    env.observation_space = gymnasium.spaces.Box(-seen, seen, shape, np.float32)
    box = gymnasium.spaces.Box(-high, high, (2,), np.float32)
    env.action_space = box if continuous else gymnasium.spaces.Discrete(5)
    return env


def sb3_model(algo: str, env: gymnasium.Env[Any, Any], **policy: object) -> Any:
    """A model of Stable-Baselines3 with random weights, large enough that its actions vary."""
    sb3 = pytest.importorskip("stable_baselines3")
    sde = {"use_sde": policy.pop("use_sde")} if "use_sde" in policy else {}
    model = getattr(sb3, algo.upper())("MlpPolicy", env, device="cpu", seed=0, policy_kwargs=policy, **sde)
    with torch.no_grad():
        for weight in model.policy.parameters():
            weight.add_(0.1 * torch.randn(weight.shape, generator=torch.Generator().manual_seed(weight.numel())))
    return model


def sb3_file(path: Path, algo: str, *, continuous: bool = False, **policy: object) -> str:
    sb3_model(algo, spaces(continuous=continuous), **policy).save(path)
    return str(path)


def driven(*words: str) -> Columns:
    """The measurements of the first unit of these options, without the wall time."""
    unit = next(unit for unit in plan_of([*SHORT.split(), *words]).units())
    return {name: column for name, column in drive(unit.job, []).columns.items() if name != "attack_ms"}


def saved(path: Path, algo: str, env: gymnasium.Env[Any, Any]) -> dict[str, str]:
    sb3_model(algo, env).save(path)
    return {"path": str(path)}
