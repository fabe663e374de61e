"""Drivers from a file: a policy is saved, loaded as a victim, and evaluated at every step of one episode."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from gymnasium import Env
from gymnasium.spaces import Box, Discrete
from matplotlib.figure import Figure
from torch import Tensor, nn

from cavbench.core.pair import choose
from cavbench.driving import Policy
from cavbench.envs.highway.config import ACTIONS
from docs.figures import style
from docs.figures.driving import FACTS, episode, policy

EVERY = 10
"""A value of the loaded victim is drawn every so many steps."""
ROWS, FEATURES = 10, 5


class _Values(nn.Module):
    """The zoo's DQN as a plain network."""

    def __init__(self) -> None:
        super().__init__()
        self.policy = policy()
        self.eval()

    def forward(self, observation: Tensor) -> Tensor:
        return self.policy.scores(observation)


def torch_file() -> Figure:
    """The zoo's DQN through `torch.export`."""

    def write(path: Path) -> Callable[[Tensor], Tensor]:
        torch.export.save(
            torch.export.export(_Values(), (torch.rand(3, ROWS, FEATURES),), dynamic_shapes=_any_batch()), path
        )
        return policy().scores

    return _figure("torch", "policy.pt2", write, "attacks may ask for scores and gradients")


def onnx_file() -> Figure:
    """The zoo's DQN through ONNX."""

    def write(path: Path) -> Callable[[Tensor], Tensor]:
        torch.onnx.export(
            _Values(),
            (torch.rand(3, ROWS, FEATURES),),
            path,
            dynamic_shapes=_any_batch(),
            input_names=["observation"],
            external_data=False,
            verbose=False,
        )
        return policy().scores

    return _figure("onnx", "policy.onnx", write, "a black box: attacks may ask for scores only")


def sb3_file() -> Figure:
    """A DQN saved by Stable-Baselines3, with random weights because none ships."""

    def write(path: Path) -> Callable[[Tensor], Tensor]:
        from stable_baselines3 import DQN

        env: Env[np.ndarray, np.int64] = Env()
        env.observation_space = Box(-1, 1, (ROWS, FEATURES), np.float32)
        env.action_space = Discrete(len(ACTIONS))
        model = DQN("MlpPolicy", env, device="cpu", seed=0)
        model.save(path)
        return model.q_net

    return _figure("sb3", "dqn.zip", write, "attacks may ask for scores and gradients")


def _any_batch() -> dict[str, dict[int, object]]:
    return {"observation": {0: torch.export.Dim("batch")}}


def _figure(victim: str, file: str, write: Callable[[Path], Callable[[Tensor], Tensor]], access: str) -> Figure:
    """Q-values of the policy that `write` saves and returns, and of the victim loaded from its file."""
    observations = torch.tensor(episode("attack=none", "victim=dqn")[1]["observation"])
    with tempfile.TemporaryDirectory() as folder, torch.no_grad():
        path = Path(folder) / file
        original = write(path)(observations)
        read: Policy = choose("victim", victim, path=str(path)).component.load(0, FACTS)
        values = read.scores(observations)
    same = int((values.argmax(-1) == original.argmax(-1)).sum())
    most = float((values - original).abs().max())
    made = style.figure(4.0, f"{victim}: {same} of {len(values)} decisions are those of the policy\nthat was written")
    axes = made.subplots()
    seconds = np.arange(len(values)) / FACTS.decision_hz
    for number, name in enumerate(ACTIONS):
        axes.plot(seconds, original[:, number], color=style.ACTIONS[name], lw=1.2)
        axes.plot(seconds[::EVERY], values[::EVERY, number], "o", ms=4, color=style.ACTIONS[name], label=name)
    axes.set(xlabel="time in an episode (s)", ylabel="Q-value", xlim=(0, seconds[-1]))
    apart = f"at most {most:.0e} apart" if most else "the same to the last bit"
    axes.set_title(f"lines: before; dots: from {file}, {apart};\n{access}", fontsize=10)
    made.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=9.5, handletextpad=0.1)
    return made
