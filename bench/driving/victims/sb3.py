"""A driver trained with Stable-Baselines3, rebuilt from its file. Only tensors are unpickled.

A saved model is a zip file. `policy.pth` holds the weights, which torch's restricted unpickler reads; `data` says in text what
they are (`cavbench.driving.victims.sb3_saved`).
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn

from cavbench.archive import Archive
from cavbench.driving import ActionType, DrivingFacts
from cavbench.driving.victims.from_file import FileDriver, FilePolicy
from cavbench.driving.victims.sb3_saved import FORMAT, ONLY, Algorithm, Saved, saved_model
from cavbench.driving.victims.sb3_traces import check_traces
from cavbench.driving.victims.spaces import Bounds, Expected, check_actions, check_range
from cavbench.errors import UserError

STEMS: dict[Algorithm, tuple[str, ...]] = {
    "dqn": ("q_net.q_net",),
    "ppo": ("mlp_extractor.policy_net", "action_net"),
    "a2c": ("mlp_extractor.policy_net", "action_net"),
    "sac": ("actor.latent_pi", "actor.mu"),
    "td3": ("actor.mu",),
    "ddpg": ("actor.mu",),
}
"""Names of the layers from the observation to the action, in order."""
OTHERS: dict[Algorithm, str] = {
    "dqn": r"q_net_target\.q_net",
    "ppo": r"mlp_extractor\.value_net|value_net|log_std",
    "a2c": r"mlp_extractor\.value_net|value_net|log_std",
    "sac": r"actor\.log_std|critic\.qf\d+|critic_target\.qf\d+",
    "td3": r"actor_target\.mu|critic\.qf\d+|critic_target\.qf\d+",
    "ddpg": r"actor_target\.mu|critic\.qf\d+|critic_target\.qf\d+",
}
"""Names of the layers that do not choose the action. Any other layer belongs to another kind of policy."""
EITHER = ("ppo", "a2c")
"""Algorithms that support both action types; the others support one."""
CRITIC = "critic.qf0"
CLIP_MEAN = 2.0
"""The default of SAC's `clip_mean`, which limits the mean of an action of gSDE before it is squashed."""


@dataclass(frozen=True, kw_only=True)
class StableBaselines3(FileDriver):
    """A policy trained with Stable-Baselines3 in this world, from the zip of `model.save`; SB3 need not be installed.

    Only `MlpPolicy`: fully connected layers on the flattened observation. It acts like `predict(deterministic=True)`. The
    algorithm, the spaces and the last observation of the training are read from the file and checked. Train without
    `VecNormalize`: the file does not contain its statistics. Only the tensors in the file are unpickled.

    Args:
        algo: the algorithm of the training; None reads it from the file.
        actions: `discrete` or `continuous`; None reads it from the file.
    """

    format: ClassVar[str] = FORMAT

    algo: Algorithm | None = None
    actions: Literal["discrete", "continuous"] | None = None  # type: ignore[assignment] # the file says it, too

    @property
    def action_type(self) -> ActionType:
        if self.algo is not None and self.algo not in EITHER:
            return "discrete" if self.algo == "dqn" else "continuous"
        return self.actions or saved_model(self.path).actions

    def read(self, path: Path, sha256: str, facts: DrivingFacts) -> FilePolicy:
        saved = saved_model(self.path)
        self._check(saved)
        check_actions(self.path, saved.actions, saved.width, facts)
        if saved.range is not None:
            check_range(self.path, saved.range, facts)
        native = self.fitted(facts, saved.observation.shape, saved.observation)
        expected = Expected(facts=facts, rows=self.rows)
        check_traces(
            self.path,
            expected,
            saved.last,
            saved.raw,
            saved.kept,
            native=native is not None,
            algorithm=saved.algorithm.upper(),
        )
        weights = torch.load(
            Archive(Archive.read(path, self.path).member("policy.pth"), f"{self.path}, policy.pth").repacked(),
            map_location="cpu",
            weights_only=True,
        )
        network, critic = _network(saved, weights), _layers(weights, CRITIC)
        valued = nn.Sequential(*_stack(critic, saved.activation)) if critic else None
        return FilePolicy(
            network, saved.observation.shape, saved.actions, saved.width, sha256, critic=valued, native=native
        )

    def _check(self, saved: Saved) -> None:
        """Refuse a file that is not what `algo` and `actions` say."""
        if self.algo not in (None, saved.algorithm):
            raise UserError(
                f"{self.path} is a model of {saved.algorithm}, victim.algo says {self.algo}; leave victim.algo out"
            )
        if self.actions not in (None, saved.actions):
            raise UserError(
                f"{self.path} has {saved.actions} actions, victim.actions says {self.actions}; leave victim.actions out"
            )


class Scaled(nn.Module):
    """Actions of a range on the [-1, 1] scale.

    Args:
        bounds: the range.
    """

    low: Tensor
    high: Tensor

    def __init__(self, bounds: Bounds) -> None:
        super().__init__()
        low, high = zip(*bounds.limits(), strict=True)
        self.register_buffer("low", torch.tensor(low))
        self.register_buffer("high", torch.tensor(high))

    def forward(self, action: Tensor) -> Tensor:
        return 2 * (action - self.low) / (self.high - self.low) - 1


def _network(saved: Saved, weights: dict[str, Tensor]) -> nn.Sequential:
    """The map from flattened observations to values of the actions, or to actions on the [-1, 1] scale."""
    stems = STEMS[saved.algorithm]
    known = rf"({'|'.join([*map(re.escape, stems), OTHERS[saved.algorithm]])})(\.\d+)?(\.(weight|bias))?"
    if strange := [key for key in weights if not re.fullmatch(known, key)]:
        raise UserError(
            f"{saved.name} has the weights {strange[0]!r}, which no MlpPolicy of {saved.algorithm} has; {ONLY}"
        )
    if any(key.endswith("weight") and weight.ndim != 2 for key, weight in weights.items()):
        raise UserError(
            f"{saved.name} has layers with weights between its linear ones ({saved.activation.__name__}); {ONLY}"
        )
    layers = [layer for stem in stems for layer in _layers(weights, stem)]
    if not layers:
        raise UserError(f"{saved.name} has no {saved.algorithm} policy: {stems[0]} is not among its weights")
    entries = math.prod(saved.observation.shape)
    if layers[0][0].shape[1] != entries:
        raise UserError(
            f"{saved.name} has a policy with {layers[0][0].shape[1]} inputs, its observation has {entries} numbers; {ONLY}"
        )
    return nn.Sequential(nn.Flatten(), *_stack(layers, saved.activation), *_head(saved, weights))


def _head(saved: Saved, weights: dict[str, Tensor]) -> list[nn.Module]:
    """What follows the last layer of a continuous policy."""
    if saved.range is None:
        return []
    if saved.algorithm in EITHER:
        if saved.options.get("squash_output"):
            return [nn.Tanh()]
        return [] if set(saved.range.limits()) == {(-1.0, 1.0)} else [Scaled(saved.range)]
    # With gSDE, SAC limits the mean: its layer is then the first of two.
    clipped = saved.algorithm == "sac" and "actor.mu.0.weight" in weights
    limit = float(saved.options.get("clip_mean", CLIP_MEAN))
    return [*([nn.Hardtanh(-limit, limit)] if clipped else []), nn.Tanh()]


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
