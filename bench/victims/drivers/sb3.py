"""A driver trained with Stable-Baselines3, rebuilt from its file. Only tensors are unpickled.

A saved model is a zip file. `policy.pth` holds the weights, which torch's restricted unpickler reads. `data` is JSON with two
versions of every object: a pickle, which is ignored, and text, from which the spaces and the activation are read.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn

from bench.archive import Archive
from bench.driving import ActionType
from bench.errors import UserError
from bench.victims.drivers.from_file import FileDriver, FilePolicy

Algorithm = Literal["dqn", "ppo", "a2c", "sac", "td3", "ddpg"]
STEMS: dict[Algorithm, tuple[str, ...]] = {
    "dqn": ("q_net.q_net",),
    "ppo": ("mlp_extractor.policy_net", "action_net"),
    "a2c": ("mlp_extractor.policy_net", "action_net"),
    "sac": ("actor.latent_pi", "actor.mu"),
    "td3": ("actor.mu",),
    "ddpg": ("actor.mu",),
}
"""Names of the layers from the observation to the action, in order."""
EITHER = ("ppo", "a2c")
"""Algorithms that support both action types; the others support one."""
CRITIC = "critic.qf0"


@dataclass(frozen=True, kw_only=True)
class StableBaselines3(FileDriver):
    """A policy trained with Stable-Baselines3 on highway-env, from the zip of `model.save`; SB3 need not be installed.

    Only `MlpPolicy`: fully connected layers on the flattened observation. It acts like `predict(deterministic=True)`. Train
    without `VecNormalize`: the file does not contain its statistics. Only the tensors in the file are unpickled.

    Args:
        algo: the algorithm of the training.
        actions: `discrete` or `continuous`, for PPO and A2C; the other algorithms support one action type.
    """

    format: ClassVar[str] = "a model of Stable-Baselines3"

    algo: Algorithm
    actions: Literal["discrete", "continuous"] = "discrete"

    @property
    def action_type(self) -> ActionType:
        if self.algo in EITHER:
            return self.actions
        return "discrete" if self.algo == "dqn" else "continuous"

    def read(self, path: Path, sha256: str, width: int) -> FilePolicy:
        saved = Archive.read(path, self.path)
        data = json.loads(saved.member("data"))
        weights = torch.load(
            Archive(saved.member("policy.pth"), f"{self.path}, policy.pth").repacked(),
            map_location="cpu",
            weights_only=True,
        )
        shape = self._observation(data["observation_space"])
        self._check_actions(data["action_space"], width)
        options = data.get("policy_kwargs") or {}
        if unsupported := sorted({"features_extractor_class", "squash_output"} & options.keys()):
            raise UserError(
                f"{self.path} has a policy with {', '.join(unsupported)}; victim 'sb3' reads a plain MlpPolicy only"
            )
        activation = _activation(options, default=nn.Tanh if self.algo in EITHER else nn.ReLU)
        layers = [layer for stem in STEMS[self.algo] for layer in _layers(weights, stem)]
        entries = self.rows * self.features
        self._check_width(layers, entries)
        squashed = self.action_type == "continuous" and self.algo not in EITHER
        network = nn.Sequential(nn.Flatten(), *_stack(layers, activation), *([nn.Tanh()] if squashed else []))
        critic = _layers(weights, CRITIC)
        valued = nn.Sequential(*_stack(critic, activation)) if critic else None
        return FilePolicy(network, shape, self.action_type, width, sha256, valued)

    def _observation(self, space: dict[str, Any]) -> list[int]:
        if not str(space.get(":type:")).endswith(".Box'>"):
            raise UserError(f"{self.path} was trained on observations of {space.get(':type:')}; the type must be Box")
        shape = [int(side) for side in space["_shape"]]
        self.check_observation(shape)
        return shape

    def _check_actions(self, space: dict[str, Any], width: int) -> None:
        discrete = str(space.get(":type:")).endswith(".Discrete'>")
        shape = [int(space["n"])] if discrete else [int(side) for side in space.get("_shape") or []]
        if discrete != (self.action_type == "discrete") or shape != [width]:
            trained = f"{shape[0]} discrete actions" if discrete else f"continuous actions {shape}"
            hint = "; set victim.actions=continuous" if self.algo in EITHER and not discrete else ""
            wanted = f"{width} {self.action_type} actions"
            raise UserError(f"{self.path} was trained for {trained}, this {self.algo} victim needs {wanted}{hint}")
        if not discrete:
            ends = [float(number) for key in ("low", "high") for number in re.findall(r"-?[\d.]+", str(space[key]))]
            if ends != [-1.0, -1.0, 1.0, 1.0]:
                raise UserError(
                    f"{self.path} was trained for actions in {space['low']} to {space['high']}, not in [-1, 1]"
                )

    def _check_width(self, layers: list[tuple[Tensor, Tensor]], entries: int) -> None:
        if not layers:
            raise UserError(f"{self.path} has no {self.algo} policy: {STEMS[self.algo][0]} is not among its weights")
        if layers[0][0].shape[1] != entries:
            raise UserError(
                f"{self.path} has a policy with {layers[0][0].shape[1]} inputs, the observation has {entries} numbers; "
                "victim 'sb3' reads a plain MlpPolicy only"
            )


def _activation(options: dict[str, Any], default: type[nn.Module]) -> type[nn.Module]:
    named = options.get("activation_fn")
    if named is None:
        return default
    match = re.fullmatch(r"<class 'torch\.nn\.modules\.activation\.(\w+)'>", str(named))
    if match is None:
        raise UserError(f"the activation {named} is not one of torch's")
    return getattr(nn, match[1])


def _layers(weights: dict[str, Tensor], stem: str) -> list[tuple[Tensor, Tensor]]:
    """Weight and bias of the linear layers under a name: a numbered sequence or a single layer."""
    numbers = sorted(
        int(found[1]) for key in weights if (found := re.fullmatch(rf"{re.escape(stem)}\.(\d+)\.weight", key))
    )
    names = [f"{stem}.{number}" for number in numbers] or ([stem] if f"{stem}.weight" in weights else [])
    return [(weights[f"{name}.weight"], weights[f"{name}.bias"]) for name in names]


def _stack(layers: list[tuple[Tensor, Tensor]], activation: type[nn.Module]) -> list[nn.Module]:
    """The layers with an activation between them."""
    modules: list[nn.Module] = []
    for weight, bias in layers:
        linear = nn.Linear(weight.shape[1], weight.shape[0])
        linear.load_state_dict({"weight": weight, "bias": bias})
        modules += [linear, activation()]
    return modules[:-1]
